"""A batch of foreign environments in several processes, as one `VectorTask`.

The rows are split into parts, each with a process of its own (see `part`). An episode depends on
its seed and its actions alone (see `worlds`), so that every row is the same to the bit in whichever
process it is, and however many there are.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UnknownName, WaspError
from wasp_cli.tasks.base import Bools, Observation, Pixels, Step, VectorTask
from wasp_cli.tasks.batch import (
    Totals,
    check_begun,
    check_options,
    checked_action,
    chosen_rows,
    running_rows,
)
from wasp_cli.tasks.declared import declaration_of, text_of
from wasp_cli.tasks.foreign.calls import calling, of_environment
from wasp_cli.tasks.foreign.closing import close_owned, opened
from wasp_cli.tasks.foreign.examine import Facts, examine
from wasp_cli.tasks.foreign.messages import Arrays
from wasp_cli.tasks.foreign.part import Part, Request
from wasp_cli.tasks.foreign.paying import pay
from wasp_cli.tasks.foreign.serving import ACTION, OUTCOMES, SOURCES, Begin, about
from wasp_cli.tasks.foreign.shared_arrays import Layout, arrays_in, made_memory
from wasp_cli.tasks.foreign.task import GymTask, observations

_SAMPLED_DECISIONS = 16
_SAMPLED_SECONDS = 0.5


def foreign_task(
    name: str,
    batch: int,
    *,
    action_repeat: int = 4,
    observe: Sequence[str] = ("pixels", "state", "privileged"),
    threads: int = 1,
) -> VectorTask:
    """Build B = `batch` episodes of the environment `name`.

    They are stepped in `threads` processes, at most one for each row, where that pays (see
    `paying`). Otherwise they are stepped in this process, one after the other. What they show is
    the same to the bit.
    """
    check_options(batch, action_repeat, threads, observations(observe))
    count = min(threads, batch)
    if count > 1:
        sample = _sampled(name, action_repeat, tuple(observe))
        if pay(batch * sample.seconds, sample.task.max_decisions):
            # Another process may not know an id that this program has registered by itself.
            with suppress(UnknownName):
                return ProcessTask(sample, batch, count)
    return GymTask(name, batch, action_repeat=action_repeat, observe=observe)


@dataclass(frozen=True)
class _Sample:
    """One environment as a task, which says what a batch of it is like."""

    name: str
    facts: Facts
    task: GymTask  # closed
    observation: Observation
    seconds: float  # of a decision


_samples: dict[tuple[str, int, tuple[str, ...]], _Sample] = {}


def _sampled(name: str, action_repeat: int, observe: tuple[str, ...]) -> _Sample:
    """Make one environment, and see how long its decisions take; once per process."""
    kept = _samples.get((name, action_repeat, observe))
    if kept is not None and kept.facts is examine(name):
        return kept
    task = GymTask(name, 1, action_repeat=action_repeat, observe=observe)
    try:
        made = sampled(task, name)
    finally:
        task.close()
    _samples[name, action_repeat, observe] = made
    return made


def sampled(task: GymTask, name: str) -> _Sample:
    """Let a task of one row, with the environment `name`, take some random decisions."""
    draws = np.random.default_rng(0)
    observation = task.reset([0])
    seconds: list[float] = []
    begun = time.perf_counter()
    ended = False
    while len(seconds) < _SAMPLED_DECISIONS and time.perf_counter() - begun < _SAMPLED_SECONDS:
        if ended:
            task.reset([0])
        action = draws.uniform(-1.0, 1.0, (1, task.action_size))
        before = time.perf_counter()
        ended = bool(task.step(action).ended[0])
        seconds.append(time.perf_counter() - before)
    # the median: the first steps may load what later ones have
    return _Sample(name, examine(name), task, observation, float(np.median(seconds)))


class ProcessTask:
    """B environments in `count` processes, as a `VectorTask`; `GymTask` is the same in this one."""

    def __init__(self, sample: _Sample, batch: int, count: int) -> None:
        """Start the processes, and wait until every one has made its environments.

        Raises:
            TaskError: one of them cannot.
        """
        one = sample.task
        self._name = sample.name
        self.batch = batch
        self.action_repeat = one.action_repeat
        self.observe = one.observe
        self.action_size = one.action_size
        self.action_low = one.action_low
        self.action_high = one.action_high
        self.privileged_size = one.privileged_size
        self.state_size = one.state_size
        self.decision_seconds = one.decision_seconds
        self.max_decisions = one.max_decisions
        self.cost_sources = one.cost_sources
        self.cameras = one.cameras

        layout = _layout(sample, batch)
        memory = made_memory(layout)
        self._arrays = arrays_in(memory, layout)
        self._arrays["ended"][:] = True
        self._begun = np.zeros(batch, np.bool_)
        self._is_waiting = False  # for answers; it stays so where the wait was broken off
        self._parts: list[Part] = []
        self._crews: list[_Crew] = opened(self, self._name)
        self._crews.append(_Crew(self._parts))
        try:
            for rows in np.array_split(np.arange(batch), count):
                begin = Begin(
                    name=self._name,
                    declared=text_of(declaration_of(self._name)),
                    first=int(rows[0]),
                    rows=len(rows),
                    action_repeat=self.action_repeat,
                    observe=self.observe,
                    layout=layout,
                    memory=memory,
                )
                self._parts.append(Part(begin))
            for answer in [part.answer() for part in self._parts]:
                self._require_same(answer, about(one))
        except BaseException:
            self.close()
            raise
        finally:
            os.close(memory)

    def _require_same(self, there: object, here: object) -> None:
        if there != here:
            raise TaskError(
                f"environment '{self._name}' is another one in another process: {there} instead of "
                f"{here}",
                "its spaces, time limit and cost sources must not depend on the process",
            )

    @property
    def pids(self) -> list[int]:
        """The numbers of the processes."""
        return [part.pid for part in self._parts]

    def close(self) -> None:
        """Close the environments, and end the processes; see `GymTask.close`."""
        close_owned(self)

    # -- episodes ----------------------------------------------------------------------------------

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        """Start new episodes in their processes; see `VectorTask`."""
        self._require_open()
        by_row = dict(chosen_rows(self.batch, seeds, rows))
        requests: list[_Asking] = []
        for part in self._parts:
            chosen = [row in by_row for row in _rows_of(part)]
            if any(chosen):
                theirs = [by_row[row] for row in _rows_of(part) if row in by_row]
                requests.append((part, ("reset", [theirs, chosen]), None))
        self._asked(requests)
        started = list(by_row)
        self._begun[started] = True
        for name in ("ended", "terminated"):
            self._arrays[name][started] = False
        return self._observation()

    def step(self, action: NDArray[Any]) -> Step:
        """Advance all parts at the same time; see `VectorTask`."""
        self._require_open()
        self._arrays[ACTION][:] = checked_action(action, self.batch, self.action_size)
        running = running_rows(self._arrays["ended"])
        # Rows of a part in which no episode runs are not asked, and have an empty step.
        for name in OUTCOMES[:4]:
            self._arrays[name][:] = 0
        self._arrays[SOURCES][:] = 0
        asked = [part for part in self._parts if not set(_rows_of(part)).isdisjoint(running)]
        self._asked([(part, ("step", []), None) for part in asked])
        arrays = self._arrays
        sources = arrays[SOURCES].T.copy()
        totals = Totals(
            reward=arrays["reward"].copy(),
            cost=arrays["cost_env"].copy(),
            goals=arrays["goals"].copy(),
            env_steps=arrays["env_steps"].copy(),
            sources=dict(zip(self.cost_sources, sources, strict=True)),
        )
        return totals.as_step(self._observation(), arrays["ended"], arrays["terminated"])

    def _asked(self, requests: Sequence[_Asking]) -> list[Any]:
        """Send requests, wait for all answers, so that none is left over, and return them. The
        failure of the first row counts, as in one process.
        """
        waiting: list[Part] = []
        answers: list[Any] = []
        failures: dict[int, WaspError] = {}
        self._is_waiting = True
        for part, request, arrays in requests:
            try:
                part.send(request, arrays)
                waiting.append(part)
            except WaspError as error:
                failures[part.begin.first] = error
        for part in waiting:
            try:
                answers.append(part.answer())
            except WaspError as error:
                failures[part.begin.first] = error
        self._is_waiting = False
        if failures:
            raise failures[min(failures)]
        return answers

    def _require_open(self) -> None:
        if not self._crews:
            raise TaskError(f"environment '{self._name}' was closed", "make the task again")
        if self._is_waiting:
            raise TaskError(
                f"environment '{self._name}' was interrupted in a step", "make the task again"
            )

    def _observation(self) -> Observation:
        fields = {name: self._arrays.get(name) for name in Observation._fields}
        return Observation(
            **{name: None if seen is None else seen.copy() for name, seen in fields.items()}
        )

    def picture(self, row: int) -> Pixels | None:
        """Return what `GymTask.picture` says."""
        self._require_open()
        part = next(part for part in self._parts if row in _rows_of(part))
        (answer,) = self._asked([(part, ("picture", [row - part.begin.first]), None)])
        return None if answer is None else answer["picture"]

    # -- snapshot ----------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return what `VectorTask` says; the environment's own part are the arrays of its
        `snapshot()`.
        """
        self._require_open()
        check_begun(self._begun)
        parts = self._asked([(part, ("snapshot", []), None) for part in self._parts])
        with of_environment(self._name), calling("snapshot"):
            return {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Observation:
        """Return to a snapshot; see `VectorTask`."""
        self._require_open()
        wrong = [name for name, array in snapshot.items() if len(array) != self.batch]
        if wrong or not {"ended", "terminated"} <= snapshot.keys():
            raise TaskError(
                f"the snapshot is not one of this task with batch {self.batch}: "
                f"'{(*wrong, 'ended')[0]}' is missing or has another shape"
            )
        requests: list[_Asking] = []
        for part in self._parts:
            rows = list(_rows_of(part))
            theirs = {name: array[rows] for name, array in snapshot.items()}
            requests.append((part, ("restore", []), theirs))
        self._asked(requests)
        for name in ("ended", "terminated"):
            self._arrays[name][:] = snapshot[name]
        self._begun[:] = True
        return self._observation()


_Asking = tuple[Part, Request, Arrays | None]
"""Who is asked, what for, and with which arrays."""


class _Crew:
    """The processes of one task, to be closed together."""

    def __init__(self, parts: list[Part]) -> None:
        self._parts = parts

    def close_elsewhere(self) -> list[str]:
        """Let all of them close their environments side by side, and return what went wrong."""
        for part in self._parts:
            part.leave()
        return [trouble for part in self._parts for trouble in part.close()]


def _layout(sample: _Sample, batch: int) -> Layout:
    """The arrays that all rows of a batch share with the processes, each of shape [B, ...]."""
    count = np.dtype(np.int64).str
    truth = np.dtype(np.bool_).str
    layout: dict[str, tuple[tuple[int, ...], str]] = {
        ACTION: ((batch, sample.task.action_size), "f8"),
        "reward": ((batch,), "f8"),
        "cost_env": ((batch,), count),
        "goals": ((batch,), count),
        "env_steps": ((batch,), count),
        "ended": ((batch,), truth),
        "terminated": ((batch,), truth),
        SOURCES: ((batch, len(sample.task.cost_sources)), count),
    }
    for name, seen in sample.observation._asdict().items():
        if seen is not None:
            layout[name] = ((batch, *seen.shape[1:]), seen.dtype.str)
    return layout


def _rows_of(part: Part) -> range:
    """The rows of the batch that a process holds."""
    return range(part.begin.first, part.begin.first + part.begin.rows)
