"""The clock of a session: when a decision begins, until when an assistant may answer, and how well that was kept."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")
KEPT = 50
"""Decisions by which the time for everything but deciding is judged."""
RESERVE = 0.15
"""Share of a period that is left for it before anything is known."""


class Clock:
    """Beats of one period in wall time; what takes longer moves all later beats, so that none is skipped."""

    def __init__(self, period: float) -> None:
        """`period` is in seconds."""
        self.period = period
        self._next = time.monotonic()
        self._rest: deque[float] = deque(maxlen=KEPT)

    def begin(self) -> None:
        """Let the next beat be now: an episode begins, or goes on after a pause."""
        self._next = time.monotonic()

    @property
    def due(self) -> float:
        """Return when the next beat is, on the monotonic clock."""
        return self._next

    def beat(self) -> tuple[float, float]:
        """Begin a decision now. Returns when it began and how many seconds after its beat."""
        now = time.monotonic()
        behind = max(now - self._next, 0.0)
        # A beat that came late by less than a tenth is caught up with; else the world waits for the assistant.
        self._next = (self._next if behind < 0.1 * self.period else now) + self.period
        return now, behind

    def deadline(self) -> float:
        """Return until when the decision of this beat is wanted: what else is to be done in the period still fits then."""
        rest = float(np.quantile(self._rest, 0.9)) if self._rest else RESERVE * self.period
        return self._next - min(rest, self.period)

    def spent(self, seconds: float) -> None:
        """Note how long everything but deciding took: the step of the world, its images, the filter, the frame."""
        self._rest.append(seconds)


class Decider(Generic[T]):
    """Asks for one thing at a time in a thread of its own, and does not wait for it for longer than it has patience."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "assistant")
        self._asked: Future[T] | None = None
        self._wanted = self._looked = 0.0
        self.answers: list[tuple[float, bool, T]] = []
        """Every answer: how many seconds it took, whether it was late, and what it was."""

    def ask(self, question: Callable[[], T], patience: float, wanted: float = -math.inf, least: float = 0.0) -> tuple[T | None, float]:
        """Return the answer, None where it is late, and the seconds waited for it.

        A late answer is thrown away; while it is still being thought about, nothing new is asked. `patience` and
        `least` count from when it can be thought about; until `wanted`, on the monotonic clock, a search is to end (`time_is_up`).
        """
        begun = time.monotonic()
        if self._asked is not None:
            wait([self._asked], patience)
            if not self._asked.done():
                return None, time.monotonic() - begun
            overdue, self._asked = self._asked, None
            overdue.result()  # thrown away, but not what went wrong there
        self._wanted = max(wanted, time.monotonic() + least)
        asked = self._thread.submit(self._timed, question, patience)
        wait([asked], patience)
        seconds = time.monotonic() - begun
        if not asked.done():
            self._asked = asked
            return None, seconds
        return asked.result(), seconds

    def time_is_up(self) -> bool:
        """Tell a question that is being answered whether a further step, as long as its last one, would end later than is wanted."""
        now = time.monotonic()
        step, self._looked = now - self._looked, now
        return now + step > self._wanted

    def _timed(self, question: Callable[[], T], patience: float) -> T:
        begun = self._looked = time.monotonic()
        answer = question()
        seconds = time.monotonic() - begun
        self.answers.append((seconds, seconds > patience, answer))
        return answer

    def finish(self) -> None:
        """Wait for what is still being thought about: an episode has ended."""
        if self._asked is not None:
            wait([self._asked])
            self._asked = None

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown()
