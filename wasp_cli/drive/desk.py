"""What the socket and the clock share: the keys that the driver holds, their requests, what is to
be shown, and whether a page is there; and the clock itself.

It is used by two threads: the clock's thread publishes frames and asks for requests; the loop of
the socket reads and writes messages. Nothing here waits for the network.
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
    """A frame for the page: numbers, and the pictures of the cameras."""

    header: Mapping[str, Any]
    pixels: bytes  # RGB of the cameras, one below the other; empty where they are not shown


@dataclass(frozen=True)
class Held:
    """The state of keys and sticks at one moment. The page sends all of it whenever it changes."""

    keys: frozenset[str] = frozenset()
    axes: tuple[float, float] = (0.0, 0.0)  # of a gamepad or a finger: forward, left in [-1, 1]
    number: int = 0  # of the message that said so; 0: none did
    at: float = 0.0  # when it arrived, on the monotonic clock

    @property
    def stick(self) -> NDArray[np.float32]:
        """(forward, left) [2] in [-1, 1]: keys and axes together. Opposite keys cancel out."""
        stick = np.array(self.axes, np.float32)
        for axis in (FORWARD, LEFT):
            stick[axis] += sum(
                {way for key in self.keys for along, way in [KEYS[key]] if along == axis}
            )
        return np.clip(stick, -1.0, 1.0)


class Desk:
    """What the two threads share: the state of the controls, requests, frames and messages. The
    methods are safe to call from either thread.
    """

    def __init__(self, changed: Callable[[], None] = lambda: None) -> None:
        # Only the latest state of the controls counts, so that nothing queues up. It is replaced as
        # a whole, which needs no lock.
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
        """Let this be the next frame that is sent. A frame that was not sent yet is dropped."""
        with self._lock:
            self._frame = self._latest = frame
        self.changed()

    def world(self, message: Mapping[str, Any]) -> None:
        """Send the description of a block; a page that connects later gets it too."""
        with self._lock:
            self._world = message
            self._latest = None
            self.say(message)

    def say(self, message: Mapping[str, Any]) -> None:
        """Queue a message for the page that is there now."""
        with self._lock:
            self._messages.append(message)
        self.changed()

    def state(self, phase: str, **facts: Any) -> None:
        """Send the phase that the session is in; a page that connects later gets it too."""
        with self._lock:
            self._state = {"phase": phase, **facts}
            self.say({"type": "state", **self._state})

    def asked(self) -> str | None:
        """Return the latest request of the driver, and forget it. Without a page that has the focus
        it is PAUSE, if nothing else was asked for.
        """
        with self._lock:
            request = self._request
            self._request = None
            return request if self.focused else request or PAUSE

    def wait(self, wanted: Collection[str] = (GO, END)) -> str:
        """Wait for one of these requests, and return it. GO counts only if the window has the
        focus.
        """
        with self._lock:
            while True:
                self._lock.wait_for(lambda: self._request is not None)
                request = self._request
                self._request = None
                if request in wanted and (request != GO or self.focused):
                    return str(request)

    def answers(self, form: Mapping[str, Any]) -> dict[str, Any] | None:
        """Show a form and wait for its answers; None if the driver ends the session instead."""
        with self._lock:
            self._answers = None
            self.state("form", form=form)
            self._lock.wait_for(lambda: self._answers is not None or self._request == END)
            return self._answers

    # The socket's side.

    def come(self) -> bool:
        """Let a driver in, and queue the block, the state and the last frame for them. Returns
        False if there is a driver already.
        """
        with self._lock:
            if self.present:
                return False
            self.present = self._free = self.focused = True
            self._sent.clear()
            self._messages.clear()
            if self._world is not None:
                self._messages.append(self._world)
            self._messages.append({"type": "state", **self._state})
            self._frame = self._latest
            return True

    def leave(self) -> None:
        """Note that the connection is gone; nothing is held any more, and the world pauses."""
        with self._lock:
            self.present = self.focused = False
            self.lost += self._state.get("phase") == "driving"
        self._release()

    def ask(self, request: str) -> None:
        """Ask for GO, PAUSE, RESTART, NEXT or END. It replaces an earlier request that was not
        taken yet, except END.
        """
        with self._lock:
            if self._request != END:
                self._request = request
            self._lock.notify_all()

    def answer(self, values: dict[str, Any]) -> None:
        """Take the answers to a form. They are ignored unless they answer all questions of the form
        that is shown: a second click may arrive when the next form is there.
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
        """Take a new state of the controls, unless the window has no focus. Unknown keys are left
        out.
        """
        if self.focused:
            self.held = Held(keys & KEYS.keys(), axes, number, time.monotonic())

    def _release(self) -> None:
        self.held = Held(number=self.held.number, at=time.monotonic())

    def outgoing(self) -> tuple[list[Mapping[str, Any]], Frame | None]:
        """Take what is to be sent now: the queued messages, and a frame if the last one was
        acknowledged.
        """
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
        """Note that the page has drawn a frame, which measures the round trip and lets the next one
        go.
        """
        with self._lock:
            sent_at = self._sent.pop(number, None)
            if sent_at is not None:
                self.round_trip = time.monotonic() - sent_at
            self._free = True
        self.changed()


def action_of(stick: NDArray[np.float32], drive: str | None) -> NDArray[np.float32]:
    """Turn a stick (forward, left) [2] into an action [2]: the inverse of `video.map.stick`.

    A point has throttle and turn rate, a car the torques of its right and left wheel. Without a
    `drive` the action is the stick itself.
    """
    action = stick
    if drive == "car":
        forward, left = stick
        action = np.array([forward + left, forward - left], np.float32)
    return np.clip(action.astype(np.float32), -1.0, 1.0)


T = TypeVar("T")
KEPT = 50  # decisions from which the time for everything but deciding is estimated
RESERVE = 0.15  # share of a period that is reserved for it before any decision was made


class Clock:
    """Beats of one period in wall time. If something takes longer, all later beats move, so that
    none is skipped.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.due = time.monotonic()
        self._rest: deque[float] = deque(maxlen=KEPT)

    def begin(self) -> None:
        """Let the next beat be now, after a start or a pause."""
        self.due = time.monotonic()

    def beat(self) -> tuple[float, float]:
        """Begin a decision now. Returns when it began, on the monotonic clock, and how many seconds
        after its beat.
        """
        now = time.monotonic()
        behind = max(now - self.due, 0.0)
        # A delay of less than a tenth of a period is caught up; a longer one moves all later beats.
        if behind >= 0.1 * self.period:
            self.due = now
        self.due += self.period
        return now, behind

    def deadline(self) -> float:
        """Return until when, on the monotonic clock, this beat's decision is wanted. What is left
        of the period is for everything else, as long as that took at nine of ten beats.
        """
        rest = RESERVE * self.period
        if self._rest:
            rest = float(np.quantile(self._rest, 0.9))
        return self.due - min(rest, self.period)

    def spent(self, seconds: float) -> None:
        """Note how long everything but the decision took, in seconds; `deadline` reserves it."""
        self._rest.append(seconds)


class Decider(Generic[T]):
    """Computes one answer at a time in a thread of its own, and waits for it only for some time."""

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
        """Return the answer, or None if it is late, and how many seconds were waited for it.

        A late answer is thrown away. While it is still being computed, no new question is asked.

        Args:
            question: computes the answer.
            patience: seconds after which an answer is late.
            wanted: until when a search should end (`time_is_up`), on the monotonic clock.
            least: seconds that a search has at least.
        """
        begun = time.monotonic()

        # A late answer to an earlier question comes first.
        if self._asked is not None:
            wait([self._asked], patience)
            if not self._asked.done():
                return None, time.monotonic() - begun
            overdue = self._asked
            self._asked = None
            overdue.result()  # raises what went wrong there; the answer itself is thrown away

        self._wanted = max(wanted, time.monotonic() + least)
        asked = self._thread.submit(self._timed, question, patience)
        wait([asked], patience)
        seconds = time.monotonic() - begun
        if not asked.done():
            self._asked = asked
            return None, seconds
        return asked.result(), seconds

    def time_is_up(self) -> bool:
        """Return whether a search should end now: another step as long as its last one would end
        after the time that is wanted. It is called by the question that is being answered.
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
        """Wait for a late answer that is still being computed, and forget it."""
        if self._asked is not None:
            wait([self._asked])
            self._asked = None

    def close(self) -> None:
        """Wait for the thread to end."""
        self._thread.shutdown()
