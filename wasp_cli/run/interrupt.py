"""How a run and its nodes are ended early: Ctrl-C and SIGTERM for the run; a time limit, and being taken back, for each node."""

from __future__ import annotations

import ctypes
import faulthandler
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
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
        """Let nothing new begin.

        Raises:
            KeyboardInterrupt: it was asked before.
        """
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


GRACE = 10.0
"""Seconds that a node has to react; one with a shorter limit gets as long again."""


@contextmanager
def limited(seconds: float | None, marker: Path, own_process: bool) -> Iterator[None]:
    """Raise TimeLimitExceeded in the block after `seconds`.

    In the main thread an alarm interrupts also what sleeps or waits. A thread of somebody else's process (a dask worker) hears of it
    between two Python instructions. Code that never comes back to Python is ended with its process, where that is ours.

    Args:
        seconds: the limit; None for none.
        marker: a file that has text when the process was ended, so that whoever finds it gone knows why.
        own_process: whether this process does nothing else.
    """
    if seconds is None:
        yield
        return
    message = f"it took longer than the limit of {duration(seconds)}"
    with _alarm(seconds, message):
        if not own_process:
            yield
            return
        with marker.open("w", encoding="utf-8") as file:
            # A thread of C: it fires also while a library holds the interpreter's lock.
            faulthandler.dump_traceback_later(seconds + min(GRACE, seconds), exit=True, file=file)
            try:
                yield
            finally:
                faulthandler.cancel_dump_traceback_later()
                marker.unlink(missing_ok=True)


@contextmanager
def _alarm(seconds: float, message: str) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        with _raised_in_thread(seconds, message):
            yield
        return

    def ring(number: int, frame: object) -> None:
        raise TimeLimitExceeded(message, HINT)

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _raised_in_thread(seconds: float, message: str) -> Iterator[None]:
    thread = ctypes.c_ulong(threading.get_ident())

    def ring() -> None:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(_Rung))

    timer = threading.Timer(seconds, ring)
    timer.daemon = True
    timer.start()
    try:
        yield
    except _Rung:
        raise TimeLimitExceeded(message, HINT) from None
    finally:
        timer.cancel()
        ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, None)  # what came too late must not reach who called us


class _Rung(Exception):
    """Python raises a class in another thread, not an instance; what it means is said where it arrives."""


HINT = "allow more time with --timeout; the log shows where it was"


LOOK_SECONDS = 0.5
"""Between two looks for a file that takes a node back."""


class Cancelled(BaseException):
    """Its node was taken back. No `Exception`: what a stage catches must not keep it going."""


@contextmanager
def cancellable(path: Path, own_process: bool) -> Iterator[None]:
    """Raise Cancelled in the block soon after a file appears.

    Code that never comes back to Python is ended with its process, where that is ours.

    Args:
        path: the file.
        own_process: whether this process does nothing else.
    """
    over = threading.Event()
    main = threading.current_thread() is threading.main_thread()
    ident = threading.get_ident()

    def look() -> None:
        while not path.exists():
            if over.wait(LOOK_SECONDS):
                return
        if main:
            signal.pthread_kill(ident, signal.SIGUSR1)
        else:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(Cancelled))
        if not over.wait(GRACE) and own_process:
            os.kill(os.getpid(), signal.SIGKILL)

    def ring(number: int, frame: object) -> None:
        if not over.is_set():
            raise Cancelled

    before = signal.signal(signal.SIGUSR1, ring) if main else None
    watcher = threading.Thread(target=look, daemon=True, name="cancel-watch")
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
        if main:
            signal.signal(signal.SIGUSR1, before)
        else:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), None)


def was_ended(marker: Path) -> bool:
    """Return whether a process was ended because its node did not react to the limit."""
    try:
        return marker.stat().st_size > 0
    except OSError:
        return False
