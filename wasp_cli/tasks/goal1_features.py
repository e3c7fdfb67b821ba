"""What Goal1 shows as vectors: the reference package's observation, and what an expert may know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks import goal1_model as g1
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.lidar import BINS, lidar, to_body

STATE_SIZE = 12 + 3 * BINS
PRIVILEGED_SIZE = 3 + 4 + 3 * g1.HAZARDS + 2

_FAR = 3.0
"""Bound of every entry of the privileged vector."""


def state_vector(sensors: Floats, qpos: Floats, goal: Floats, hazards: Floats) -> Floats:
    """float64 [B, 60]: accelerometer, velocimeter, gyro, magnetometer, then 16 lidar bins of goal, hazards, vase.

    Args:
        sensors: [B, 12] in this order.
        qpos: [B, 10] agent pose x, y, yaw, then the vase's pose.
        goal: [B, 2].
        hazards: [B, 8, 2].
    """
    lidars = [lidar(_seen(points, qpos)) for points in (goal[:, None], hazards, qpos[:, None, 3:5])]
    return np.concatenate([sensors, *lidars], axis=1)


def privileged_vector(velocity: Floats, turn: Floats, qpos: Floats, goal: Floats, hazards: Floats) -> NDArray[np.float32]:
    """float32 [B, 33], entries within [-3, 3]; everything in the robot's frame, lengths in m unless said.

    0-1 velocity (m/s); 2 turn rate (3 rad/s); 3-4 direction of the goal, 5 its distance / 3, 6 exp(-distance);
    then for each hazard, nearest first, its position / 1.5 (2) and twice the clearance from its rim, clipped to [-0.2, 1] m;
    last the vase's position / 1.5 (2).

    Args:
        velocity: [B, 2] mean world velocity over the last env step (the instantaneous sensors chatter).
        turn: [B] mean turn rate over the last decision step in rad/s.
        qpos: as for `state_vector`; goal, hazards too.
    """
    own_velocity = to_body(velocity[:, None], np.zeros_like(velocity), np.ascontiguousarray(qpos[:, 2]))[:, 0]
    target = _seen(goal[:, None], qpos)[:, 0]
    distance = _norm(target)[:, None]
    around = _seen(hazards, qpos)
    range_ = _norm(around)
    order = np.argsort(range_, axis=1, kind="stable")
    around, range_ = np.take_along_axis(around, order[..., None], axis=1), np.take_along_axis(range_, order, axis=1)
    clearance = 2.0 * np.clip(range_ - g1.HAZARD_RADIUS, -g1.HAZARD_RADIUS, 1.0)
    threats = np.concatenate([around / 1.5, clearance[..., None]], axis=2).reshape(len(qpos), -1)
    vase = _seen(qpos[:, None, 3:5], qpos)[:, 0] / 1.5
    parts = [own_velocity, turn[:, None] / 3.0, target / np.maximum(distance, 1e-9), distance / 3.0, np.exp(-distance), threats, vase]
    vector: NDArray[np.float32] = np.clip(np.concatenate(parts, axis=1), -_FAR, _FAR).astype(np.float32)
    return vector


def _seen(points: Floats, qpos: Floats) -> Floats:
    return to_body(points, qpos[:, :2], np.ascontiguousarray(qpos[:, 2]))


def _norm(vectors: Floats) -> Floats:
    x, y = vectors[..., 0], vectors[..., 1]
    norm: Floats = np.sqrt(x * x + y * y)
    return norm
