"""Ctrl-C before a command begins and after it has ended: it ends the process at once, since nothing could be lost.

As an exception it would pass through imports and the end of Python, and some of these print it or turn it into another one.
"""

import os
import signal

INTERRUPTED = 130


def end_at_once() -> None:
    """Let Ctrl-C end this process with the exit code of an interruption, unless it was started to ignore it or has a handler of its own."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def end_in_order() -> None:
    """Let Ctrl-C be an exception again, for a command that has begun."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(number: int, frame: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)
