"""What a driver holds down now, and the action that it means.

The page sends the whole state of keys and sticks whenever it changes. What is kept is the latest one: a decision samples it, so that
nothing queues up behind a slow moment. The socket writes it, the clock reads it: one reference, so that no lock is needed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FORWARD, LEFT = 0, 1
KEYS = {
    "ArrowUp": (FORWARD, 1.0), "KeyW": (FORWARD, 1.0), "ArrowDown": (FORWARD, -1.0), "KeyS": (FORWARD, -1.0),
    "ArrowLeft": (LEFT, 1.0), "KeyA": (LEFT, 1.0), "ArrowRight": (LEFT, -1.0), "KeyD": (LEFT, -1.0),
}  # fmt: skip
"""By `KeyboardEvent.code`: along which axis of the stick, and which way."""


@dataclass(frozen=True)
class Held:
    """What is held at one moment."""

    keys: frozenset[str] = frozenset()
    """of KEYS"""
    axes: tuple[float, float] = (0.0, 0.0)
    """of a gamepad or a finger: forward, left in [-1, 1]"""
    number: int = 0
    """of the message that said so; 0: none did"""
    at: float = 0.0
    """when it arrived, on the monotonic clock"""

    @property
    def stick(self) -> NDArray[np.float32]:
        """Return (forward, left) [2] in [-1, 1]: keys and axes together, opposite keys cancel out."""
        stick = np.array(self.axes, np.float32)
        for axis in (FORWARD, LEFT):
            stick[axis] += sum({way for key in self.keys for along, way in [KEYS[key]] if along == axis})
        return np.clip(stick, -1.0, 1.0)


class Controls:
    """The latest state of the controls."""

    def __init__(self) -> None:
        self._held = Held()

    def hold(self, keys: frozenset[str], axes: tuple[float, float], number: int) -> None:
        """Take a new state; keys that mean nothing here are left out."""
        self._held = Held(keys & KEYS.keys(), axes, number, time.monotonic())

    def release(self) -> None:
        """Let go of everything: the window lost the focus, or the connection broke."""
        self._held = Held(number=self._held.number, at=time.monotonic())

    def now(self) -> Held:
        """Return what is held now."""
        return self._held


def action_of(stick: NDArray[np.float32], drive: str | None) -> NDArray[np.float32]:
    """Turn a stick (forward, left) [2] into an action [2]: the inverse of `video.map.stick`.

    A point has throttle and turn rate, a car the torques of the driver's right and left wheel. A task that does not say how it is driven
    gets the stick as it is.
    """
    forward, left = stick
    action = np.array([forward + left, forward - left] if drive == "car" else [forward, left], np.float32)
    return np.clip(action, -1.0, 1.0)
