"""Rotations and changes of frame, for batches. B = episodes, K = points."""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats


def yaw_rotation(yaw: Floats) -> Floats:
    """Return body to world [..., 3, 3] of upright bodies turned by `yaw` [...] in rad."""
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    zero = np.zeros_like(yaw)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1.0]
    return np.stack(rows, axis=-1).reshape(*yaw.shape, 3, 3)


def quaternion_rotation(quaternion: Floats) -> Floats:
    """Return body to world [..., 3, 3] of unit quaternions w, x, y, z [..., 4]."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    ww = w * w
    xx = x * x
    yy = y * y
    zz = z * z
    rotation = np.empty((*quaternion.shape[:-1], 3, 3))
    # The diagonal.
    rotation[..., 0, 0] = ww + xx - yy - zz
    rotation[..., 1, 1] = ww - xx + yy - zz
    rotation[..., 2, 2] = ww - xx - yy + zz
    # The pairs beside it.
    rotation[..., 0, 1] = 2.0 * (x * y - w * z)
    rotation[..., 1, 0] = 2.0 * (x * y + w * z)
    rotation[..., 2, 0] = 2.0 * (x * z - w * y)
    rotation[..., 0, 2] = 2.0 * (x * z + w * y)
    rotation[..., 1, 2] = 2.0 * (y * z - w * x)
    rotation[..., 2, 1] = 2.0 * (y * z + w * x)
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
    x = points[..., 0] - origin[:, None, 0]
    y = points[..., 1] - origin[:, None, 1]
    cos = np.cos(yaw)[:, None]
    sin = np.sin(yaw)[:, None]
    local = np.empty(points.shape)
    local[..., 0] = cos * x + sin * y
    local[..., 1] = cos * y - sin * x
    return local


def ground_to_body(points: Floats, position: Floats, rotation: Floats) -> Floats:
    """Transform world points [B, K, 2] on the ground into frames of bodies [B, 3] that may be
    tilted [B, 3, 3] -> x and y [B, K, 2].
    """
    dx = points[..., 0] - position[:, None, 0]
    dy = points[..., 1] - position[:, None, 1]
    dz = -position[:, None, 2]
    axis = rotation[:, None]
    local = np.empty(points.shape)
    local[..., 0] = dx * axis[..., 0, 0] + dy * axis[..., 1, 0] + dz * axis[..., 2, 0]
    local[..., 1] = dx * axis[..., 0, 1] + dy * axis[..., 1, 1] + dz * axis[..., 2, 1]
    return local


def distance(a: Floats, b: Floats) -> Floats:
    """Return Euclidean distances [...] of points [..., 2], in their unit."""
    dx = a[..., 0] - b[..., 0]
    dy = a[..., 1] - b[..., 1]
    apart: Floats = np.sqrt(dx * dx + dy * dy)
    return apart


def wrapped(angle: Floats) -> Floats:
    """Return the same angles [...] in [-pi, pi) rad."""
    within: Floats = np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
    return within
