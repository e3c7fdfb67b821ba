"""Commands run in this process."""

from pathlib import Path

from click.testing import Result
from typer.testing import CliRunner

from wasp_cli import console
from wasp_cli.cli import app


def run_here(*arguments: str | Path, columns: int | None, code: int | None = None) -> Result:
    """`wasp ARGUMENTS` with a terminal of so many columns, or in a pipe, and the exit code that is asked for.

    The consoles keep the stream of their first use, which belongs to an earlier test or is closed with the runner.
    """
    consoles = (console.out, console.err)
    for made in consoles:
        made.cache_clear()
    try:
        done = CliRunner().invoke(app, list(map(str, arguments)), env={"COLUMNS": columns and str(columns)})
    finally:
        for made in consoles:
            made.cache_clear()
    assert code in (None, done.exit_code), done.output
    return done
