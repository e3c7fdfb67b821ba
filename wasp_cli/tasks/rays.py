"""Distances to what costs, along rays around a robot on flat ground. B = episodes, K = circles, V = walls' sides."""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats

RAYS = 32
"""Rays around the robot, the first one straight ahead, counter-clockwise."""


def ray_distances(origin: Floats, heading: Floats, circles: Floats, radius: float, sides: Floats, limit: float) -> Floats:
    """Distance [B, 32] in m to the first circle or side on each ray, at most `limit`; 0 inside a circle.

    Args:
        origin: [B, 2].
        heading: [B] direction of the first ray in rad.
        circles: [B, K, 2] centres, all of one `radius` in m.
        sides: [V, 2, 2] start and end points of walls.
        limit: in m.
    """
    angle = heading[:, None] + np.arange(RAYS) * (2.0 * np.pi / RAYS)
    ux, uy = np.cos(angle), np.sin(angle)
    return np.minimum(_to_circles(origin, ux, uy, circles, radius, limit), _to_sides(origin, ux, uy, sides, limit))


def _to_circles(origin: Floats, ux: Floats, uy: Floats, circles: Floats, radius: float, limit: float) -> Floats:
    offset = circles - origin[:, None]
    near = np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2) < limit + radius
    most = int(near.sum(axis=1).max(initial=0))
    if not most:
        return np.full_like(ux, limit)
    # Only those within reach: there are 200 barrels, of which some five are.
    order = np.argsort(~near, axis=1, kind="stable")[:, :most]
    offset = np.take_along_axis(offset, order[..., None], axis=1)
    dx, dy = offset[:, None, :, 0], offset[:, None, :, 1]
    along = ux[..., None] * dx + uy[..., None] * dy
    across = ux[..., None] * dy - uy[..., None] * dx
    half_chord2 = radius**2 - across**2
    entry = along - np.sqrt(np.maximum(half_chord2, 0.0))
    leave = along + np.sqrt(np.maximum(half_chord2, 0.0))
    hit = np.where((half_chord2 > 0.0) & (leave > 0.0), np.maximum(entry, 0.0), limit)
    nearest: Floats = np.minimum(hit.min(axis=-1), limit)
    return nearest


def _to_sides(origin: Floats, ux: Floats, uy: Floats, sides: Floats, limit: float) -> Floats:
    if not len(sides):
        return np.full_like(ux, limit)
    # Sides out of everybody's reach are left out first.
    low, high = origin.min(axis=0) - limit, origin.max(axis=0) + limit
    close = ((sides.max(axis=1) >= low) & (sides.min(axis=1) <= high)).all(axis=1)
    sides = sides[close]
    if not len(sides):
        return np.full_like(ux, limit)
    start, along = sides[:, 0], sides[:, 1] - sides[:, 0]
    px, py = (start[:, 0] - origin[:, None, 0])[:, None], (start[:, 1] - origin[:, None, 1])[:, None]
    ux, uy = ux[..., None], uy[..., None]
    # origin + t u = start + s along
    turn = ux * along[:, 1] - uy * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (px * along[:, 1] - py * along[:, 0]) / turn
        s = (px * uy - py * ux) / turn
        hit = (t >= 0.0) & (s >= 0.0) & (s <= 1.0)
    nearest: Floats = np.where(hit, t, limit).min(axis=-1)
    return np.minimum(nearest, limit)
