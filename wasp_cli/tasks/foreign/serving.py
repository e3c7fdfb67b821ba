"""The program of a process that holds some rows of a batch of foreign environments: it does what
it is asked over a socket (see `part`), and writes what environments show into shared arrays.
"""

from __future__ import annotations

import faulthandler
import json
import os
import signal
import socket
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import WaspError, described
from wasp_cli.tasks.base import Floats, Observation
from wasp_cli.tasks.declared import declare
from wasp_cli.tasks.foreign.closing import environments
from wasp_cli.tasks.foreign.messages import Stream, receive, send
from wasp_cli.tasks.foreign.shared_arrays import Layout, arrays_in
from wasp_cli.tasks.foreign.started import lead_session
from wasp_cli.tasks.foreign.task import GymTask

ACTION = "action"
OUTCOMES = ("reward", "cost_env", "goals", "env_steps", "ended", "terminated")
"""Fields of `Step` that are shared as they are; each is [B]."""
SOURCES = "sources"  # [B, number of cost sources]
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True)
class Begin:
    """What a process is told first."""

    name: str  # of the environment
    declared: str  # what a spec says of it, as JSON
    first: int  # row of the batch
    rows: int
    action_repeat: int
    observe: tuple[str, ...]
    layout: Layout  # of the arrays that are shared, over all rows of the batch
    memory: int  # their descriptor


def serve(descriptor: int) -> None:
    """Do what is asked over a socket until its other end is closed; then close the environments.

    Standard output is for what goes wrong in closing. What environments print goes to stderr.
    """
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    faulthandler.enable()
    lead_session()
    report = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    # Lines must not wait in a buffer: a process that dies would take what it said along.
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    connection = socket.socket(fileno=descriptor)
    connection.set_inheritable(False)
    with environments(sys.stderr, quiet=True) as scope, suppress(OSError, EOFError):
        _answer_all(connection.makefile("rwb"))
    with suppress(OSError), report:
        report.write(json.dumps(scope.troubles) + "\n")


def _answer_all(stream: Stream) -> None:
    """Answer every request, until the stream ends: the first one with what the environment is.

    An answer is `{"value": ...}` with the arrays that a method returns, or says with what a
    request failed: `{"error": message, "hint": hint, "kind": class}`.
    """
    told, _ = receive(stream)
    served: Served | None = None
    try:
        served = Served(Begin(**told))
        send(stream, {"value": served.about()})
    except Exception as error:
        if isinstance(error, OSError):
            raise
        send(stream, _told(error))
    while True:
        (what, arguments), arrays = receive(stream)
        try:
            returned = getattr(served, what)(*arguments, **arrays)
        except Exception as error:
            send(stream, _told(error))
        else:
            send(stream, {"value": None}, returned)


def _told(error: Exception) -> dict[str, str | None]:
    """A failure as it travels; one that nobody expected is printed here, where it happened."""
    if isinstance(error, WaspError):
        return {"error": error.message, "hint": error.hint, "kind": type(error).__name__}
    traceback.print_exception(error)
    message = f"the process of an environment failed: {described(error)}"
    return {"error": message, "hint": None, "kind": "TaskError"}


class Served:
    """The rows of this process. What its methods do is said by those of `VectorTask`; what they
    show is in the shared arrays, and not returned.
    """

    def __init__(self, begin: Begin) -> None:
        shared = arrays_in(begin.memory, begin.layout)
        declare(begin.name, json.loads(begin.declared))
        rows = slice(begin.first, begin.first + begin.rows)
        self._arrays = {name: array[rows] for name, array in shared.items()}
        self._task = GymTask(
            begin.name, begin.rows, action_repeat=begin.action_repeat, observe=begin.observe
        )

    def about(self) -> list[object]:
        """Return what has to be the same in every process."""
        return about(self._task)

    def reset(self, seeds: Sequence[int], rows: Sequence[bool]) -> None:
        """Start new episodes."""
        self._show(self._task.reset(seeds, np.array(rows)))

    def step(self) -> None:
        """Advance under the shared action."""
        action: Floats = self._arrays[ACTION]
        step = self._task.step(action)
        for name in OUTCOMES:
            self._arrays[name][:] = getattr(step, name)
        for number, source in enumerate(self._task.cost_sources):
            self._arrays[SOURCES][:, number] = step.sources[source]
        self._show(step.observation)

    def picture(self, row: int) -> dict[str, NDArray[Any]] | None:
        """Return what a row draws of itself, by the name `picture`; None where it draws nothing."""
        picture = self._task.picture(row)
        return None if picture is None else {"picture": picture}

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return everything that determines the future of the rows."""
        return self._task.snapshot()

    def restore(self, **snapshot: NDArray[Any]) -> None:
        """Return to a snapshot, given by its arrays."""
        self._show(self._task.restore(snapshot))

    def _show(self, observation: Observation) -> None:
        for name, value in observation._asdict().items():
            if value is not None:
                self._arrays[name][:] = value


def about(task: GymTask) -> list[object]:
    """Return what a batch of environments is, whatever the number of its rows, as JSON values."""
    return [
        task.action_size,
        task.state_size,
        task.privileged_size,
        list(task.cost_sources),
        task.max_decisions,
        task.decision_seconds,
        task.cameras,
    ]
