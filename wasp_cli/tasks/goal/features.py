"""What Goal shows as vectors: the reference package's observation, and what an expert may know.

B = episodes, K = hazards, F = vases.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import to_body
from wasp_cli.tasks.goal import model as g
from wasp_cli.tasks.lidar import BINS, lidars
from wasp_cli.tasks.privileged import MOTION_AND_GOAL, bounded, motion_and_goal, nearness
from wasp_cli.tasks.rays import RAYS, ray_distances

_RAY_LIMIT = 3.0
_NO_WALLS = np.zeros((0, 2, 2))


def state_size(hazards: int, vases: int) -> int:
    """Length of the state vector."""
    return g.AGENT_SENSORS + BINS * (1 + (hazards > 0) + (vases > 0))


def privileged_size(hazards: int, vases: int) -> int:
    """Length of the privileged vector."""
    return MOTION_AND_GOAL + 3 * hazards + 2 * vases + (RAYS if hazards else 0)


def state_vector(sensors: Floats, pose: Floats, goal: Floats, hazards: Floats, vases: Floats) -> Floats:
    """float64 [B, S]: accelerometer, velocimeter, gyro, magnetometer, then 16 lidar bins of goal, hazards, vases (of those there are).

    Args:
        sensors: [B, 12] in this order.
        pose: [B, 3] agent x, y, yaw.
        goal: [B, 2].
        hazards: [B, K, 2].
        vases: [B, F, 2].
    """
    kinds = [points for points in (goal[:, None], hazards, vases) if points.shape[1]]
    seen = to_body(np.concatenate(kinds, axis=1), pose[:, :2], pose[:, 2])
    return np.concatenate([sensors, lidars(seen, [points.shape[1] for points in kinds])], axis=1)


def privileged_vector(velocity: Floats, turn: Floats, pose: Floats, goal: Floats, hazards: Floats, vases: Floats) -> NDArray[np.float32]:
    """float32 [B, P], entries within [-3, 3]; everything in the robot's frame, lengths in m unless said.

    First `motion_and_goal`; then for each hazard, nearest first, its position / 1.5 (2) and twice the clearance from its rim, clipped to
    [-0.2, 1] m; then the vases' positions / 1.5 (2 each, nearest first); last the nearness of hazards along 32 rays.

    Args:
        velocity: [B, 2] mean world velocity over the last env step (the instantaneous sensors chatter).
        turn: [B] mean turn rate over the last decision step in rad/s.
        pose: as for `state_vector`; goal, hazards and vases too.
    """
    xy, yaw = pose[:, :2], pose[:, 2]
    parts = [motion_and_goal(velocity, turn, xy, yaw, goal)]
    around, range_ = _nearest_first(to_body(hazards, xy, yaw))
    clearance = 2.0 * np.clip(range_ - g.HAZARD_RADIUS, -g.HAZARD_RADIUS, 1.0)
    parts.append(np.concatenate([around / 1.5, clearance[..., None]], axis=2).reshape(len(pose), -1))
    parts.append(_nearest_first(to_body(vases, xy, yaw))[0].reshape(len(pose), -1) / 1.5)
    if hazards.shape[1]:
        parts.append(nearness(ray_distances(xy, yaw, hazards, g.HAZARD_RADIUS, _NO_WALLS, _RAY_LIMIT)))
    return bounded(*parts)


def _nearest_first(points: Floats) -> tuple[Floats, Floats]:
    """Points [B, K, 2] by their distance from the origin, and the distances [B, K]."""
    range_ = np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2)
    order = np.argsort(range_, axis=1, kind="stable")
    return np.take_along_axis(points, order[..., None], axis=1), np.take_along_axis(range_, order, axis=1)
