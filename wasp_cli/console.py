"""The two consoles: results go to stdout, everything else to stderr. Rich is imported when something is printed."""

from __future__ import annotations

import sys
from functools import cache
from typing import TYPE_CHECKING

from wasp_cli.errors import Interrupted, WaspError

if TYPE_CHECKING:
    from rich.console import Console


@cache
def out() -> Console:
    """For results: tables, JSON, paths."""
    from rich.console import Console

    return Console(highlight=False, soft_wrap=not sys.stdout.isatty())


@cache
def err() -> Console:
    """For progress, notes and errors."""
    from rich.console import Console

    # The stream of the start: what a stage prints in this process is redirected to its log, progress is not.
    return Console(file=sys.stderr, highlight=False, soft_wrap=not sys.stderr.isatty())


def plain(text: str) -> None:
    """Print a line to stderr as it is, whatever brackets it holds."""
    err().print(text, markup=False, soft_wrap=True)


def report_error(error: WaspError) -> None:
    """Print an expected error: what happened, then how to fix it."""
    if not isinstance(error, Interrupted):
        err().print("[bold red]error:[/] ", end="")
    err().print(error.message, markup=False, soft_wrap=True)
    if error.hint:
        err().print(f"       {error.hint}", markup=False, soft_wrap=True)


def duration(seconds: float) -> str:
    """A time as people say it: 0.4 s, 12 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min"
