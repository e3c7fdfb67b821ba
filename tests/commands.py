"""Commands run in this process."""

from pathlib import Path

from click.testing import Result
from typer.testing import CliRunner

from wasp_cli import console
from wasp_cli.cli.app import app


def run_here(*arguments: str | Path, columns: int) -> Result:
    """`wasp ARGUMENTS` with a terminal of so many columns.

    The consoles keep the stream of their first use, which belongs to an earlier test or is closed with the runner.
    """
    consoles = (console.out, console.err)
    for made in consoles:
        made.cache_clear()
    try:
        return CliRunner().invoke(app, list(map(str, arguments)), env={"COLUMNS": str(columns)})
    finally:
        for made in consoles:
            made.cache_clear()
