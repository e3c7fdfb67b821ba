"""Rotations and changes of frame, for batches. B = episodes, K = points."""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats


def yaw_rotation(yaw: Floats) -> Floats:
    """Return body to world [..., 3, 3] of upright bodies turned by `yaw` [...] in rad."""
    cos, sin, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1.0]
    return np.stack(rows, axis=-1).reshape(*yaw.shape, 3, 3)


def quaternion_rotation(quaternion: Floats) -> Floats:
    """Return body to world [..., 3, 3] of unit quaternions w, x, y, z [..., 4]."""
    w, x, y, z = quaternion[..., 0], quaternion[..., 1], quaternion[..., 2], quaternion[..., 3]
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    rotation = np.empty((*quaternion.shape[:-1], 3, 3))
    rotation[..., 0, 0], rotation[..., 1, 1], rotation[..., 2, 2] = (
        ww + xx - yy - zz,
        ww - xx + yy - zz,
        ww - xx - yy + zz,
    )
    for i, j, product, turn in ((0, 1, x * y, w * z), (2, 0, x * z, w * y), (1, 2, y * z, w * x)):
        rotation[..., i, j] = 2.0 * (product - turn)
        rotation[..., j, i] = 2.0 * (product + turn)
    return rotation


def yaw_quaternion(yaw: Floats) -> Floats:
    """Return unit quaternions w, x, y, z [..., 4] of upright bodies turned by `yaw` [...] in
    rad.
    """
    zero = np.zeros_like(yaw)
    return np.stack([np.cos(yaw / 2.0), zero, zero, np.sin(yaw / 2.0)], axis=-1)


def to_body(points: Floats, origin: Floats, yaw: Floats) -> Floats:
    """Transform world points [B, K, 2] into upright body frames at `origin` [B, 2] in m turned
    by `yaw` [B] in rad -> [B, K, 2].
    """
    x, y = points[..., 0] - origin[:, None, 0], points[..., 1] - origin[:, None, 1]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    seen = np.empty(points.shape)
    seen[..., 0], seen[..., 1] = cos * x + sin * y, cos * y - sin * x
    return seen


def ground_to_body(points: Floats, position: Floats, rotation: Floats) -> Floats:
    """Transform world points [B, K, 2] on the ground into frames of bodies [B, 3] that may be
    tilted [B, 3, 3] -> x and y [B, K, 2].
    """
    dx, dy = points[..., 0] - position[:, None, 0], points[..., 1] - position[:, None, 1]
    dz = -position[:, None, 2]
    axis = rotation[:, None]
    seen = np.empty(points.shape)
    seen[..., 0] = dx * axis[..., 0, 0] + dy * axis[..., 1, 0] + dz * axis[..., 2, 0]
    seen[..., 1] = dx * axis[..., 0, 1] + dy * axis[..., 1, 1] + dz * axis[..., 2, 1]
    return seen


def distance(a: Floats, b: Floats) -> Floats:
    """Return Euclidean distances [...] of points [..., 2], in their unit."""
    dx, dy = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    apart: Floats = np.sqrt(dx * dx + dy * dy)
    return apart


def wrapped(angle: Floats) -> Floats:
    """Return the same angles [...] in [-pi, pi) rad."""
    within: Floats = np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
    return within
