"""The time limit of a node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from wasp_cli.console import duration
from wasp_cli.errors import TimeLimitExceeded
from wasp_cli.tasks.foreign.limit import LimitReached, left_after, process_ended_after

GRACE = 10.0  # seconds that a node has to react, but at most its limit again
HINT = "allow more time with --timeout; the log shows where it was"


@contextmanager
def interruptible(limit: float | None, marker: Path, own_process: bool) -> Iterator[None]:
    """Raise TimeLimitExceeded in the block after `limit` seconds (see `left_after`).

    Code that does not come back to Python is ended with its process if `own_process`. The file
    `marker` is then not empty, so that others see why the process ended.
    """
    if limit is None:
        yield
        return
    try:
        with _ended_over(limit, marker) if own_process else nullcontext(), left_after(limit):
            yield
    except LimitReached:
        raise TimeLimitExceeded(
            f"it took longer than the limit of {duration(limit)}", HINT
        ) from None


@contextmanager
def _ended_over(limit: float, marker: Path) -> Iterator[None]:
    with marker.open("w", encoding="utf-8") as file:
        try:
            with process_ended_after(limit + min(GRACE, limit), file):
                yield
        finally:
            marker.unlink(missing_ok=True)


def was_ended(marker: Path) -> bool:
    """Return whether the process that wrote a marker was ended over its limit."""
    with suppress(OSError):
        return marker.stat().st_size > 0
    return False
