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
    """Say how many cells are published, and how many of them each spec takes."""
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
    # no process of ours imports from the working directory, which may be somebody's results
    os.environ["PYTHONSAFEPATH"] = "1"
    # nor draws into a notebook or a window, or in a user's own style: also a task that draws its
    # images with matplotlib shows the same on every machine
    os.environ |= {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
    for stream in (sys.stdout, sys.stderr):
        # an ASCII terminal shows ? where it has no character
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    words = [
        *(["--debug"] if "--debug" in sys.argv[1:] else []),
        *(word for word in sys.argv[1:] if word != "--debug"),
    ]
    try:
        with environments(sys.__stderr__):  # whichever a command makes are closed at its end
            app(words)
    except SystemExit as end:
        _end_without_threads(end.code if isinstance(end.code, int) else int(end.code is not None))
        raise


def _end_without_threads(code: int) -> None:
    """End this process soon also where an environment has left a thread behind, for which Python
    would wait.
    """

    def end() -> None:
        time.sleep(THREAD_SECONDS)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)

    if any(not thread.daemon for thread in threading.enumerate()[1:]):
        threading.Thread(target=end, daemon=True, name="end").start()
