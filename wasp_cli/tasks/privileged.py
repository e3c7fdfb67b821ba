"""Parts of the vector from which experts learn: what all tasks have in common. B = episodes.

Nothing here has the lidar's horizon of 3 m, and nothing of it is ever shown to an assistant.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import to_body

BOUND = 3.0
"""Bound of every entry of the privileged vector."""

MOTION_AND_GOAL = 7


def motion_and_goal(velocity: Floats, turn: Floats, xy: Floats, heading: Floats, goal: Floats) -> Floats:
    """[B, 7]: own velocity (2, m/s), turn rate (3 rad/s), direction of the goal (2), its distance / 3 m and exp(-distance / 1 m).

    Vectors are in the frame whose x axis is the robot's front.

    Args:
        velocity: [B, 2] world velocity in m/s.
        turn: [B] rad/s.
        xy: [B, 2].
        heading: [B] of the robot's front in rad.
        goal: [B, 2].
    """
    own = to_body(velocity[:, None], np.zeros_like(velocity), heading)[:, 0]
    target = to_body(goal[:, None], xy, heading)[:, 0]
    apart = np.sqrt(target[:, :1] ** 2 + target[:, 1:] ** 2)
    return np.concatenate([own, turn[:, None] / 3.0, target / np.maximum(apart, 1e-9), apart / 3.0, np.exp(-apart)], axis=1)


def nearness(distances: Floats) -> Floats:
    """Ray distances in m as numbers that tell most where it matters: 1 at contact, 0.37 at 0.5 m, 0.05 at 1.5 m."""
    near: Floats = np.exp(-2.0 * distances)
    return near


def bounded(*parts: Floats) -> NDArray[np.float32]:
    """The parts [B, ...] as one float32 vector within the bound."""
    vector: NDArray[np.float32] = np.clip(np.concatenate(parts, axis=1), -BOUND, BOUND).astype(np.float32)
    return vector
