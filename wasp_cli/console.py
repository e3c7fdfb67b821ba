"""The two consoles: results go to stdout, everything else to stderr. Rich is imported when
something is printed.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
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
    # The stream at the start of the process: what a stage prints later is redirected to its log,
    # while progress is not.
    return _console(sys.stderr, file=sys.stderr)


# columns of a pipe or a file unless COLUMNS is set, so that nothing is cut off there
ENDLESS = 10_000


def _console(stream: TextIO, **options: Any) -> Console:
    from rich.console import Console

    class Lasting(Console):
        """A console that goes quiet when its reader goes away. Rich would end the program with 1,
        but a run goes on and has an exit code of its own.
        """

        def on_broken_pipe(self) -> None:
            self.quiet = True
            silence(stream)

    pipe = not stream.isatty()
    width = ENDLESS if pipe and not os.environ.get("COLUMNS") else None
    return Lasting(**options, highlight=False, emoji=False, soft_wrap=pipe, width=width)


def silence(stream: TextIO) -> None:
    """Discard what a stream still holds, and all that is written to it from now on."""
    # A stream without a file descriptor holds nothing back.
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, stream.fileno())
        finally:
            os.close(nowhere)


def say(*lines: str | Text) -> None:
    """Print lines to stdout as they are; brackets are no markup."""
    for line in lines:
        out().print(line, markup=False, soft_wrap=True)


def count_table(words: str, *numbers: str) -> Table:
    """Return a table without lines: a column of words, and a right-aligned column for each of
    `numbers`.
    """
    from rich.table import Table

    table = Table(box=None, padding=(0, 2), header_style="bold")
    table.add_column(words)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def plain(text: str) -> None:
    """Print a line to stderr as it is; brackets are no markup."""
    err().print(text, markup=False, soft_wrap=True)


def waiting_aloud(text: str) -> Callable[[], bool]:
    """Return a function for waits that ask each time whether to go on: it prints `text` once, and
    goes on.
    """

    @cache
    def wait() -> bool:
        plain(text)
        return True

    return wait


@contextmanager
def announced_if_slow(text: str, seconds: float) -> Iterator[None]:
    """Print `text` to stderr, once, if the block takes longer than `seconds`.

    Code of others may wait for something that never comes, and what waits cannot say so itself.
    Native code that holds the interpreter's lock delays the line.
    """
    timer = threading.Timer(seconds, plain, [text])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def following(name: str) -> Iterator[Callable[[float, str], None]]:
    """Yield a function that shows on the terminal how far something is, from 0 to 1; elsewhere it
    shows nothing.
    """
    with err().status(name) as status:
        yield lambda share, text: status.update(f"{name}: {100 * share:.0f} %, {text}")


def report_error(error: WaspError) -> None:
    """Print an expected error and its hint to stderr."""
    if not isinstance(error, Interrupted):
        err().print("[bold red]error:[/] ", end="")
    plain(error.message)
    if error.hint:
        plain(f"       {error.hint}")


def duration(seconds: float) -> str:
    """Return a duration in words, such as `8.3 s`, `4 min 05 s` or `2 h 10 min`."""
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
    """Return a number of bytes in words, such as `1.2 MB`; `?` for None."""
    from rich.filesize import decimal

    return "?" if count is None else decimal(count)


# Before a command begins and after it has ended, Ctrl-C and SIGTERM end the process at once, since
# nothing can be lost. An exception would pass through imports and the shutdown of Python, and some
# of these print it or turn it into another one.
INTERRUPTED = 130
ENDING = (signal.SIGINT, signal.SIGTERM)


def end_at_once() -> None:
    """Let SIGINT and SIGTERM end this process at once with exit code 130, unless they are ignored
    or have another handler.
    """
    for number in ENDING:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, _end)


def end_in_order() -> None:
    """Let SIGINT and SIGTERM raise KeyboardInterrupt again, for a command that has begun: it cleans
    up what it made.
    """
    for number in ENDING:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.default_int_handler)


def _end(number: int, frame: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)
