"""The two consoles: results go to stdout, everything else to stderr. Rich is imported when
something is printed.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import TYPE_CHECKING, Any, TextIO

from wasp_cli.errors import Interrupted, WaspError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text


@cache
def out() -> Console:
    """Return the console for results: tables, JSON, paths."""
    return _console(sys.stdout)


@cache
def err() -> Console:
    """Return the console for progress, notes and errors."""
    # The stream of the start: what a stage prints in this process is redirected to its log,
    # progress is not.
    return _console(sys.stderr, file=sys.stderr)


# columns of a pipe or a file, unless COLUMNS says otherwise: nothing is left out there for want of
# room
ENDLESS = 10_000


def _console(stream: TextIO, **options: Any) -> Console:
    from rich.console import Console

    class Lasting(Console):
        """Rich would end the program with 1 when the reader goes away: a run goes on, and its
        exit code tells how it ended.
        """

        def on_broken_pipe(self) -> None:
            self.quiet = True
            silence(stream)

    pipe = not stream.isatty()
    width = ENDLESS if pipe and not os.environ.get("COLUMNS") else None
    return Lasting(**options, highlight=False, emoji=False, soft_wrap=pipe, width=width)


def silence(stream: TextIO) -> None:
    """Send what a stream still holds, and gets from now on, to nowhere."""
    # no file descriptor: nothing that could be closed behind our back
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, stream.fileno())
        finally:
            os.close(nowhere)


def say(*lines: str | Text) -> None:
    """Print lines to stdout as they are, whatever brackets they hold."""
    for line in lines:
        out().print(line, markup=False, soft_wrap=True)


def count_table(words: str, *numbers: str) -> Table:
    from rich.table import Table

    table = Table(box=None, padding=(0, 2), header_style="bold")
    table.add_column(words)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def plain(text: str) -> None:
    """Print a line to stderr as it is, whatever brackets it holds."""
    err().print(text, markup=False, soft_wrap=True)


def waiting_aloud(text: str) -> Callable[[], bool]:
    """Return what a wait asks each time whether to go on: it says why once, and goes on."""

    @cache
    def wait() -> bool:
        plain(text)
        return True

    return wait


@contextmanager
def following(name: str) -> Iterator[Callable[[float, str], None]]:
    """Show a line on the terminal that says how far something is; nothing elsewhere."""
    with err().status(name) as status:
        yield lambda share, text: status.update(f"{name}: {100 * share:.0f} %, {text}")


def report_error(error: WaspError) -> None:
    if not isinstance(error, Interrupted):
        err().print("[bold red]error:[/] ", end="")
    plain(error.message)
    if error.hint:
        plain(f"       {error.hint}")


def duration(seconds: float) -> str:
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min"


def size(count: int | None) -> str:
    from rich.filesize import decimal

    return "?" if count is None else decimal(count)


# Ctrl-C or SIGTERM before a command begins and after it has ended ends the process at once, since
# nothing could be lost. As an exception it would pass through imports and the end of Python, and
# some of these print it or turn it into another one.
INTERRUPTED = 130
ENDING = (signal.SIGINT, signal.SIGTERM)


def end_at_once() -> None:
    """Let these signals end this process with an interruption's exit code; not one that is
    ignored or has another handler.
    """
    for number in ENDING:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, _end)


def end_in_order() -> None:
    """Let these signals be an exception, for a command that has begun: what it made for itself
    goes with it.
    """
    for number in ENDING:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.default_int_handler)


def _end(number: int, frame: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)
