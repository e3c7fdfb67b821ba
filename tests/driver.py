"""A scripted driver: it follows the task's own route and heeds no hazard."""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import wrapped
from wasp_cli.tasks.navigation import Navigation


def drive(task: Navigation, target: Floats | None = None) -> Floats:
    """Choose an action [B, 2] in [-1, 1] that steers toward `target` [B, 2] in m, by default
    the next point of the route.
    """
    xy, heading, velocity = task.pose()
    offset = (task.route() if target is None else target) - xy
    if task.drive == "car":
        return _steer_car(_bearing(offset, heading))
    # The point robot slides: what it has to turn to is the change of its velocity.
    apart = np.sqrt((offset**2).sum(axis=1, keepdims=True))
    change = offset / np.maximum(apart, 1e-9) * np.minimum(1.5 * apart + 0.1, 1.0) - velocity
    return _steer_point(_bearing(change, heading))


def _bearing(towards: Floats, heading: Floats) -> Floats:
    """Directions of vectors [B, 2] seen from headings [B], in [-pi, pi)."""
    return wrapped(np.arctan2(towards[:, 1], towards[:, 0]) - heading)


def _steer_point(bearing: Floats) -> Floats:
    # The turn servo is deaf below 0.1; the throttle saturates at 0.05.
    turn = np.where(
        np.abs(bearing) > 0.05, np.clip(0.1 * np.sign(bearing) + 0.5 * bearing, -1.0, 1.0), 0.0
    )
    return np.stack([0.05 * np.clip(np.cos(bearing), 0.0, 1.0), turn], axis=1)


def _steer_car(bearing: Floats) -> Floats:
    # Wheel torques saturate at 0.02. The first wheel is the driver's right one: more of it turns
    # left.
    turn = 0.02 * np.clip(1.2 * bearing, -1.0, 1.0)
    forward = 0.02 * np.clip(1.5 - np.abs(bearing), 0.0, 1.0)
    right = forward + np.where(turn > 0.0, turn, 1.5 * turn)
    left = forward - np.where(turn > 0.0, 1.5 * turn, turn)
    return np.stack([right, left], axis=1)
