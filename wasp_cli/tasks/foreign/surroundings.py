"""Code of others gets no screen, no sound, and no standard output: that may be a table or a plan as
JSON.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

HEADLESS = {
    # not `dummy` alone: where that is chosen, highway-env draws nothing
    "SDL_VIDEODRIVER": "offscreen,dummy",
    "SDL_AUDIODRIVER": "dummy",
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
}
"""Variables that keep pygame and other games on SDL from windows, sound and greetings."""


def go_headless() -> None:
    """Let environments that are imported and made from now on open no window. What the user has
    set stays.
    """
    for name, value in HEADLESS.items():
        os.environ.setdefault(name, value)


@contextmanager
def printing_aside() -> Iterator[None]:
    """Send to standard error what is printed in the block, from C libraries too."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        with suppress(OSError, ValueError):  # one of them is closed, or no file
            stack.enter_context(_redirected(1, 2))
        yield


@contextmanager
def _redirected(number: int, into: int) -> Iterator[None]:
    """Let one file descriptor mean another one in the block."""
    with suppress(OSError, ValueError, AttributeError):
        sys.__stdout__.flush()  # type: ignore[union-attr]
    original = os.dup(number)
    try:
        os.dup2(into, number)
        yield
    finally:
        os.dup2(original, number)
        os.close(original)
