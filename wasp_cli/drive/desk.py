"""Between the socket and the clock: what the driver holds down and asked for, what is to be shown,
and who is there; and the clock.

Two threads meet here. The clock's thread publishes and asks; the socket's loop reads and writes.
Nothing here waits for the network.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

GO = "go"
PAUSE = "pause"
RESTART = "restart"
NEXT = "next"
END = "end"
ROUND_TRIPS = 20  # frames whose acknowledgement may be outstanding before their times are forgotten

FORWARD = 0
LEFT = 1
KEYS = {
    "ArrowUp": (FORWARD, 1.0),
    "KeyW": (FORWARD, 1.0),
    "ArrowDown": (FORWARD, -1.0),
    "KeyS": (FORWARD, -1.0),
    "ArrowLeft": (LEFT, 1.0),
    "KeyA": (LEFT, 1.0),
    "ArrowRight": (LEFT, -1.0),
    "KeyD": (LEFT, -1.0),
}
"""By `KeyboardEvent.code`: along which axis of the stick, and which way."""


class Frame(NamedTuple):
    header: Mapping[str, Any]
    pixels: bytes  # RGB of the cameras, one below the other; empty where they are not shown


@dataclass(frozen=True)
class Held:
    """What is held at one moment. The page sends the whole state of keys and sticks whenever it
    changes.
    """

    keys: frozenset[str] = frozenset()
    axes: tuple[float, float] = (0.0, 0.0)  # of a gamepad or a finger: forward, left in [-1, 1]
    number: int = 0  # of the message that said so; 0: none did
    at: float = 0.0  # when it arrived, on the monotonic clock

    @property
    def stick(self) -> NDArray[np.float32]:
        """Return (forward, left) [2] in [-1, 1]: keys and axes together, opposite keys cancel
        out.
        """
        stick = np.array(self.axes, np.float32)
        for axis in (FORWARD, LEFT):
            stick[axis] += sum(
                {way for key in self.keys for along, way in [KEYS[key]] if along == axis}
            )
        return np.clip(stick, -1.0, 1.0)


class Desk:
    def __init__(self, changed: Callable[[], None] = lambda: None) -> None:
        # the latest state of the controls: nothing queues up behind a slow moment. One reference,
        # which needs no lock.
        self.held = Held()
        self.changed = changed
        self._lock = threading.Condition()
        self._request: str | None = None
        self._answers: dict[str, Any] | None = None
        self._world: Mapping[str, Any] | None = None
        self._frame: Frame | None = None
        self._latest: Frame | None = None
        self._messages: deque[Mapping[str, Any]] = deque(maxlen=200)
        self._state: Mapping[str, Any] = {"phase": "starting"}
        self.present = self.focused = False
        # how often the connection broke, and the window lost the focus, while someone drove
        self.lost = 0
        self.blurred = 0
        self._sent: dict[int, float] = {}
        self._free = True
        self.round_trip = float("nan")  # of the last acknowledged frame, in seconds

    # The clock's side.

    def show(self, frame: Frame) -> None:
        """Let this be the next frame that is sent; one that was not sent yet is never sent."""
        with self._lock:
            self._frame = self._latest = frame
        self.changed()

    def world(self, message: Mapping[str, Any]) -> None:
        """Say what is driven in now; whoever connects later is told too."""
        with self._lock:
            self._world = message
            self._latest = None
            self.say(message)

    def say(self, message: Mapping[str, Any]) -> None:
        with self._lock:
            self._messages.append(message)
        self.changed()

    def state(self, phase: str, **facts: Any) -> None:
        """Say what goes on now; whoever connects later is told too."""
        with self._lock:
            self._state = {"phase": phase, **facts}
            self.say({"type": "state", **self._state})

    def asked(self) -> str | None:
        """Return and forget what was asked for. Where nobody is there, or the window has no
        focus, it is a pause.
        """
        with self._lock:
            request = self._request
            self._request = None
            return request if self.focused else request or PAUSE

    def wait(self, wanted: Collection[str] = (GO, END)) -> str:
        """Wait for one of these requests; GO counts with the window's focus alone."""
        with self._lock:
            while True:
                self._lock.wait_for(lambda: self._request is not None)
                request = self._request
                self._request = None
                if request in wanted and (request != GO or self.focused):
                    return str(request)

    def answers(self, form: Mapping[str, Any]) -> dict[str, Any] | None:
        """Show a form and wait for its answers; None where the driver ends instead."""
        with self._lock:
            self._answers = None
            self.state("form", form=form)
            self._lock.wait_for(lambda: self._answers is not None or self._request == END)
            return self._answers

    # The socket's side.

    def come(self) -> bool:
        """Let a driver in, who is told what goes on and shown the last frame; not where there
        is one already.
        """
        with self._lock:
            if self.present:
                return False
            self.present = self._free = self.focused = True
            self._sent.clear()
            self._messages.clear()
            self._messages.extend(
                ([] if self._world is None else [self._world]) + [{"type": "state", **self._state}]
            )
            self._frame = self._latest
            return True

    def leave(self) -> None:
        with self._lock:
            self.present = self.focused = False
            self.lost += self._state.get("phase") == "driving"
        self._release()

    def ask(self, request: str) -> None:
        """Ask for GO, PAUSE, RESTART, NEXT or END. A later one takes the place of an earlier
        one that nobody heard, but not that of END.
        """
        with self._lock:
            if self._request != END:
                self._request = request
            self._lock.notify_all()

    def answer(self, values: dict[str, Any]) -> None:
        """Take answers to all questions of the form that is shown, and no others: a second
        click may come when the next form is there.
        """
        with self._lock:
            form = self._state.get("form")
            if form is not None and values.keys() - {"agreed"} == {
                scale["name"] for scale in form["scales"]
            }:
                self._answers = values
                self._lock.notify_all()

    def focus(self, there: bool) -> None:
        """Note whether the window has the focus; without it nothing is held."""
        with self._lock:
            self.blurred += self.focused and not there and self._state.get("phase") == "driving"
            self.focused = there
        if not there:
            self._release()

    def hold(self, keys: frozenset[str], axes: tuple[float, float], number: int) -> None:
        """Take a new state of the controls, unless the window has no focus; keys that mean
        nothing here are left out.
        """
        if self.focused:
            self.held = Held(keys & KEYS.keys(), axes, number, time.monotonic())

    def _release(self) -> None:
        self.held = Held(number=self.held.number, at=time.monotonic())

    def outgoing(self) -> tuple[list[Mapping[str, Any]], Frame | None]:
        with self._lock:
            messages = list(self._messages)
            self._messages.clear()
            frame = None
            if self._free and self._frame is not None:
                frame = self._frame
                self._frame = None
                self._free = False
                self._sent[int(frame.header["frame"])] = time.monotonic()
                while len(self._sent) > ROUND_TRIPS:
                    del self._sent[next(iter(self._sent))]
            return messages, frame

    def acknowledged(self, number: int) -> None:
        with self._lock:
            if (sent := self._sent.pop(number, None)) is not None:
                self.round_trip = time.monotonic() - sent
            self._free = True
        self.changed()


def action_of(stick: NDArray[np.float32], drive: str | None) -> NDArray[np.float32]:
    """Turn a stick (forward, left) [2] into an action [2]: the inverse of `video.map.stick`.

    A point has throttle and turn rate, a car the torques of the driver's right and left wheel. A
    task that does not say how it is driven gets the stick as it is.
    """
    forward, left = stick
    action = np.array(
        [forward + left, forward - left] if drive == "car" else [forward, left], np.float32
    )
    return np.clip(action, -1.0, 1.0)


T = TypeVar("T")
KEPT = 50  # decisions by which the time for everything but deciding is judged
RESERVE = 0.15  # share of a period that is left for it before anything is known


class Clock:
    """Beats of one period in wall time; what takes longer moves all later beats, so that none
    is skipped.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.due = time.monotonic()
        self._rest: deque[float] = deque(maxlen=KEPT)

    def begin(self) -> None:
        self.due = time.monotonic()

    def beat(self) -> tuple[float, float]:
        """Begin a decision now. Returns when it began and how many seconds after its beat."""
        now = time.monotonic()
        behind = max(now - self.due, 0.0)
        # A beat that came late by less than a tenth is caught up with; else the world waits for the
        # assistant.
        self.due = (self.due if behind < 0.1 * self.period else now) + self.period
        return now, behind

    def deadline(self) -> float:
        """Return until when the decision of this beat is wanted: what else is to be done in the
        period still fits then.
        """
        rest = float(np.quantile(self._rest, 0.9)) if self._rest else RESERVE * self.period
        return self.due - min(rest, self.period)

    def spent(self, seconds: float) -> None:
        self._rest.append(seconds)


class Decider(Generic[T]):
    """Asks for one thing at a time in a thread of its own, and does not wait for it for longer
    than it has patience.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "assistant")
        self._asked: Future[T] | None = None
        self._wanted = self._looked = 0.0
        # every answer: how many seconds it took, whether it was late, and what it was
        self.answers: list[tuple[float, bool, T]] = []

    def ask(
        self,
        question: Callable[[], T],
        patience: float,
        wanted: float = -math.inf,
        least: float = 0.0,
    ) -> tuple[T | None, float]:
        """Return the answer, None where it is late, and the seconds waited for it.

        A late answer is thrown away; while it is still being thought about, nothing new is asked.
        `patience` and `least` count from when it can be thought about; until `wanted`, on the
        monotonic clock, a search is to end (`time_is_up`).
        """
        begun = time.monotonic()
        if self._asked is not None:
            wait([self._asked], patience)
            if not self._asked.done():
                return None, time.monotonic() - begun
            overdue = self._asked
            self._asked = None
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
        """Tell a question that is being answered whether a further step, as long as its last
        one, would end later than is wanted.
        """
        now = time.monotonic()
        step = now - self._looked
        self._looked = now
        return now + step > self._wanted

    def _timed(self, question: Callable[[], T], patience: float) -> T:
        begun = self._looked = time.monotonic()
        answer = question()
        seconds = time.monotonic() - begun
        self.answers.append((seconds, seconds > patience, answer))
        return answer

    def finish(self) -> None:
        if self._asked is not None:
            wait([self._asked])
            self._asked = None

    def close(self) -> None:
        self._thread.shutdown()
