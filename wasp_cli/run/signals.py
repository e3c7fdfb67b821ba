"""The signals that end a run, and which processes handle them. Processes that an environment starts
begin with the default handlers, whatever the run and its workers do with these signals.
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
    """Set the handler of a signal in this process, but not in processes that it starts: `exec`
    resets handlers (though an ignored signal would stay ignored), and a fork without `exec` gets
    the default.
    """
    _handlers.add(handler)
    signal.signal(number, handler)


def leave_to_parent() -> None:
    """Let this process survive the signals that end a run: the process that started it decides."""
    for number in SIGNALS:
        handle(number, _left)
        signal.siginterrupt(number, False)  # system calls in native code are not interrupted
    # This process began with them held back (see `signals_wait`); its children must not.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def _left(number: int, frame: object) -> None: ...


_mask = threading.local()  # the mask of a thread before it forks


def _hold_back() -> None:
    """Hold signals back until a fork has the default handlers; otherwise they would be lost."""
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
    """Within the block, hold back signals while processes start. They inherit this thread's mask; a
    signal before they are ready would end them with a traceback.
    """
    from multiprocessing import resource_tracker as of_python

    from joblib.externals.loky.backend import resource_tracker

    # Workers need both trackers, and starting one would unblock the signals.
    for tracker in (resource_tracker, of_python):
        tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
