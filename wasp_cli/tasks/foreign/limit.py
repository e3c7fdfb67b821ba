"""Time limits for code of others, which may wait for ever, in Python or in native code."""

from __future__ import annotations

import ctypes
import faulthandler
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TextIO


class LimitReached(Exception):
    """A block took longer than it was given."""


class _Overdue(BaseException):
    """Python raises a class in another thread, not an instance; what it means is said where it
    arrives.
    """


@contextmanager
def left_after(seconds: float) -> Iterator[None]:
    """Raise LimitReached out of the block when it has taken `seconds`.

    In the main thread a signal interrupts also what sleeps or waits. Another thread (of a dask
    worker) hears of it between two Python instructions. Native code that never comes back to Python
    is not interrupted: see `process_ended_after`. Blocks may stand in one another.
    """
    over = threading.Event()  # the block has ended
    rung = threading.Event()  # its time is up
    thread = threading.get_ident()
    main = threading.current_thread() is threading.main_thread()

    def watch() -> None:
        """Interrupt the block from a thread of its own."""
        if over.wait(seconds):
            return
        rung.set()
        if main:
            signal.pthread_kill(thread, signal.SIGUSR1)
        else:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(
                ctypes.c_ulong(thread), ctypes.py_object(_Overdue)
            )

    before = signal.getsignal(signal.SIGUSR1) if main else None

    def ring(number: int, frame: FrameType | None) -> None:
        """Handle the signal in the main thread."""
        if not rung.is_set():  # of a block around this one
            if callable(before):
                before(number, frame)
        elif not over.is_set():
            raise _Overdue

    if main:
        signal.signal(signal.SIGUSR1, ring)
    watcher = threading.Thread(target=watch, daemon=True, name="limit")
    watcher.start()
    try:
        yield
    except _Overdue:
        if not rung.is_set():  # of a block around this one
            raise
        raise LimitReached from None
    finally:
        over.set()
        watcher.join()
        if main:
            signal.signal(signal.SIGUSR1, before)
        elif rung.is_set():  # an exception that came too late must not reach the caller
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), None)


_ends: list[tuple[float, TextIO]] = []  # of the blocks that are open: when, and the last words


@contextmanager
def process_ended_after(seconds: float, last_words: TextIO) -> Iterator[None]:
    """End this process, with exit code 1, when the block has taken `seconds`: also where native
    code holds the interpreter's lock. `last_words` then gets what every thread was doing.

    Blocks may stand in one another; only one thread uses them.
    """
    end = (time.monotonic() + seconds, last_words)
    _ends.append(end)
    _arm()
    try:
        yield
    finally:
        _ends.remove(end)
        _arm()


def _arm() -> None:
    """Set the one timer there is, a thread of C, to the end that comes first."""
    faulthandler.cancel_dump_traceback_later()
    if _ends:
        at, last_words = min(_ends, key=lambda end: end[0])
        left = max(at - time.monotonic(), 0.001)
        faulthandler.dump_traceback_later(left, exit=True, file=last_words)
