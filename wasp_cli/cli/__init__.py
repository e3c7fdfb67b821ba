"""The `wasp` program. Each command parses, makes one call and returns an exit code; heavy
imports are inside the commands.
"""

from __future__ import annotations

import io
import os
import sys
import threading
import time
from typing import Annotated

import typer

from wasp_cli import __version__
from wasp_cli.cli import (  # noqa: F401 (each adds its commands)
    check,
    compare,
    doctor,
    draw,
    drive,
    explain,
    export,
    gc,
    names,
    note,
    plan,
    publish,
    replay,
    report,
    run,
    spec,
    status,
    submit,
    sweep,
    try_out,
    verify,
    view,
)
from wasp_cli.cli.command import app
from wasp_cli.cli.parameters import flag
from wasp_cli.spec.shipped import published_contents
from wasp_cli.tasks.foreign.closing import environments

THREAD_SECONDS = 5.0  # that a thread may run on when a command has ended


def _print_version(asked: bool) -> None:
    """Print the version and what comes with it, and end the program, if that was asked."""
    if asked:
        print(f"wasp {__version__}")
        print(_published_data())
        raise typer.Exit


def _published_data() -> str:
    """How many cells are published, and how many of them each spec uses."""
    published = published_contents()
    if not published.cells:
        return "published: nothing"
    most_first = sorted(published.specs.items(), key=lambda each: -each[1])
    specs = ", ".join(f"{cells} of {name}" for name, cells in most_first)
    return f"published: {published.cells} cells, among them {specs}; specs share cells"


@app.callback()
def main_options(
    debug: Annotated[
        bool, flag("--debug", "Show the traceback of expected errors too (or set WASP_DEBUG=1).")
    ] = False,
    version: Annotated[
        bool,
        flag(
            "--version",
            "Print the version and what is published, and exit.",
            callback=_print_version,
            is_eager=True,
        ),
    ] = False,
) -> None:
    """Take the options of every command."""
    if debug:
        os.environ["WASP_DEBUG"] = "1"


def main() -> None:
    """Run the command in `sys.argv`; ends with SystemExit and its exit code."""
    # Processes that are started here do not import from the working directory, which may be a
    # folder of somebody's results.
    os.environ["PYTHONSAFEPATH"] = "1"
    # matplotlib opens no window and uses no style of the user, so that tasks that draw their images
    # with it show the same on every machine.
    os.environ |= {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
    for stream in (sys.stdout, sys.stderr):
        # A terminal that lacks a character shows ? in its place.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")

    # --debug may stand anywhere, also behind the command.
    words = [word for word in sys.argv[1:] if word != "--debug"]
    if len(words) < len(sys.argv) - 1:
        words.insert(0, "--debug")
    try:
        with environments(sys.__stderr__):  # environments that a command makes are closed
            app(words)
    except SystemExit as end:
        _end_without_threads(end.code if isinstance(end.code, int) else int(end.code is not None))
        raise


def _end_without_threads(code: int) -> None:
    """End this process soon, even if an environment has left a thread behind: Python would wait for
    it.
    """

    def end() -> None:
        time.sleep(THREAD_SECONDS)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)

    if any(not thread.daemon for thread in threading.enumerate()[1:]):
        threading.Thread(target=end, daemon=True, name="end").start()
