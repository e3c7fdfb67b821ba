"""Commands run in this process, and in one of their own."""

import os
import subprocess
import sys
from pathlib import Path

from click.testing import Result
from typer.testing import CliRunner

from wasp_cli import console
from wasp_cli.cli import app

ROOT = Path(__file__).parents[1]


def python(
    folder: Path, *arguments: str, path: tuple[Path, ...] = (), code: int | None = None
) -> subprocess.CompletedProcess[str]:
    """Python in a folder, as the console script of `wasp` is run: with `-P` it does not search
    the current folder by itself.
    """
    variables = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, [*path, ROOT])),
        "NO_COLOR": "1",
        "COLUMNS": "200",
    }
    command = [sys.executable, "-P", *arguments]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=600, env=variables, check=False
    )
    assert code in (None, done.returncode), done.stdout + done.stderr
    return done


def wasp(
    folder: Path, *arguments: str, code: int | None = None
) -> subprocess.CompletedProcess[str]:
    return python(folder, "-m", "wasp_cli", *arguments, code=code)


def run_here(*arguments: str | Path, columns: int | None, code: int | None = None) -> Result:
    """`wasp ARGUMENTS` with a terminal of so many columns, or in a pipe, and the exit code that is
    asked for.

    The consoles keep the stream of their first use, which belongs to an earlier test or is closed
    with the runner.
    """
    consoles = (console.out, console.err)
    for made in consoles:
        made.cache_clear()
    try:
        done = CliRunner().invoke(
            app, list(map(str, arguments)), env={"COLUMNS": columns and str(columns)}
        )
    finally:
        for made in consoles:
            made.cache_clear()
    assert code in (None, done.exit_code), done.output
    return done
