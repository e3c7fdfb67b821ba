"""The signals that end a run, and who gets them: never a process that an environment starts, which
begins with the defaults, whatever the run and its workers do with them.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)

Handler = Callable[[int, Any], Any]

_DEFAULTS: dict[signal.Signals, Handler | signal.Handlers] = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGTERM: signal.SIG_DFL,
}

_handlers: set[Handler] = set()


def handle(number: signal.Signals, handler: Handler) -> None:
    """Let `handler` have a signal in this process, and in no process that it starts: `exec` takes
    handlers back, but keeps a signal ignored that was. A fork without `exec` gets the default.
    """
    _handlers.add(handler)
    signal.signal(number, handler)


def leave_to_parent() -> None:
    """Let this process live through signals that are the business of the one that started it."""
    for number in SIGNALS:
        handle(number, _left)
        signal.siginterrupt(number, False)  # what waits in native code need not know of it
    # this process began with them held back (see `signals_wait`), and so would its children
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def _left(number: int, frame: object) -> None: ...


_mask = threading.local()  # of a thread that forks, from before


def _hold_back() -> None:
    """Let a signal to a fork wait until the fork has the defaults: it would be lost."""
    _mask.before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS if _handlers else ())


def _let_come() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _mask.before)


def _default_in_fork() -> None:
    for number in SIGNALS:
        if signal.getsignal(number) in _handlers:
            signal.signal(number, _DEFAULTS[number])
    _let_come()


os.register_at_fork(before=_hold_back, after_in_parent=_let_come, after_in_child=_default_in_fork)


@contextmanager
def signals_wait() -> Iterator[None]:
    """Hold back signals while processes start. They begin with this thread's mask; one that is
    not ready would end with a traceback.
    """
    from multiprocessing import resource_tracker as of_python

    from joblib.externals.loky.backend import resource_tracker

    # a worker needs both, and each lifts the mask when it starts
    for tracker in (resource_tracker, of_python):
        tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
