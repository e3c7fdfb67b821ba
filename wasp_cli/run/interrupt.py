"""How a run and its nodes are ended early: Ctrl-C and SIGTERM for the run; a time limit, and being taken back, for each node."""

from __future__ import annotations

import ctypes
import faulthandler
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from wasp_cli.console import duration
from wasp_cli.errors import TimeLimitExceeded

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Whether a run was asked to stop. Workers learn it from a file, on other machines too."""

    def __init__(self, path: Path, told: Callable[[], None]) -> None:
        self._path, self._told = path, told
        self.asked = False

    def ask(self) -> None:
        """Let nothing new begin."""
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        with suppress(OSError):
            self._path.touch()
        self._told()


@contextmanager
def listening(stop: Stop) -> Iterator[None]:
    """Turn signals into requests to stop. One that this process was started to ignore (`nohup`) stays ignored."""

    def ask(number: int, frame: object) -> None:
        stop.ask()

    before = {number: signal.getsignal(number) for number in SIGNALS}
    taken = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    try:
        for number in taken:
            signal.signal(number, ask)
        yield
    finally:
        for number in taken:
            signal.signal(number, before[number])


GRACE = 10.0  # seconds that a node has to react; one with a shorter limit gets as long again
LOOK_SECONDS = 0.5
HINT = "allow more time with --timeout; the log shows where it was"


class Cancelled(BaseException):
    """Its node was taken back. No `Exception`: what a stage catches must not keep it going."""


class _Overdue(BaseException):
    """Python raises a class in another thread, not an instance; what it means is said where it arrives."""


@contextmanager
def interruptible(limit: float | None, cancel: Path, marker: Path, own_process: bool) -> Iterator[None]:
    """Raise TimeLimitExceeded in the block after `limit` seconds, and Cancelled soon after a file appears.

    In the main thread a signal interrupts also what sleeps or waits. A thread of somebody else's process (a dask worker) hears of it
    between two Python instructions. Code that never comes back to Python is ended with its process, where that is ours;
    `marker` then has text, so that whoever finds it gone knows why.
    """
    over, thread = threading.Event(), threading.get_ident()
    main = threading.current_thread() is threading.main_thread()
    reason: type[BaseException] = Cancelled

    def watch() -> None:
        nonlocal reason
        end = math.inf if limit is None else time.monotonic() + limit
        while not cancel.exists():
            left = end - time.monotonic()
            if left <= 0:
                reason = _Overdue
                break
            if over.wait(min(LOOK_SECONDS, left)):
                return
        if main:
            signal.pthread_kill(thread, signal.SIGUSR1)
        else:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(reason))
        if reason is Cancelled and not over.wait(GRACE) and own_process:
            os.kill(os.getpid(), signal.SIGKILL)

    def ring(number: int, frame: object) -> None:
        if not over.is_set():
            raise reason

    before = signal.signal(signal.SIGUSR1, ring) if main else None
    watcher = threading.Thread(target=watch, daemon=True, name="node-watch")
    watcher.start()
    try:
        with _ended_over(limit, marker) if limit is not None and own_process else nullcontext():
            yield
    except _Overdue:
        raise TimeLimitExceeded(f"it took longer than the limit of {duration(limit or 0.0)}", HINT) from None
    finally:
        over.set()
        watcher.join()
        if main:
            signal.signal(signal.SIGUSR1, before)
        else:  # what came too late must not reach who called us
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), None)


@contextmanager
def _ended_over(limit: float, marker: Path) -> Iterator[None]:
    """End this process where it does not react to the limit."""
    with marker.open("w", encoding="utf-8") as file:
        # A thread of C: it fires also while a library holds the interpreter's lock.
        faulthandler.dump_traceback_later(limit + min(GRACE, limit), exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            marker.unlink(missing_ok=True)


def was_ended(marker: Path) -> bool:
    """Return whether a process was ended because its node did not react to the limit."""
    try:
        return marker.stat().st_size > 0
    except OSError:
        return False
