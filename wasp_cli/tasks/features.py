"""Parts of the vectors that tasks show: pseudo lidar, ray distances, and what only experts may
know. B = episodes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import to_body

BINS = 16
RANGE = 3.0  # distance in m from which an object is no longer seen


def lidars(points: Floats, sizes: Sequence[int]) -> Floats:
    """Return the pseudo lidar: nearness in [0, 1] per bin [B, 16 J] of the centres [B, K, 2] in m
    of J kinds of objects, in the body frame.

    Bin 0 starts at body +x, counter-clockwise. An object lights its own bin by s, and the
    neighbours by how near it is to their edge.

    Args:
        points: all kinds one after the other along K.
        sizes: how many objects there are of each kind; they add up to K.
    """
    out = np.zeros((len(points), BINS * len(sizes)))
    x, y = points[..., 0], points[..., 1]
    nearness = np.maximum(0.0, RANGE - np.hypot(x, y)) / RANGE
    rows, columns = np.nonzero(nearness)
    if not rows.size:
        return out
    first = BINS * np.repeat(np.arange(len(sizes)), sizes)[columns]
    place = np.mod(np.arctan2(y[rows, columns], x[rows, columns]), 2.0 * np.pi) / (
        2.0 * np.pi / BINS
    )
    floor = np.floor(place)
    # mod of a tiny negative angle rounds to 2 pi itself, hence the second mod.
    own, s, f = floor.astype(np.intp) % BINS, nearness[rows, columns], place - floor
    for target, value in ((own, s), ((own + 1) % BINS, f * s), ((own - 1) % BINS, (1.0 - f) * s)):
        np.maximum.at(out, (rows, first + target), value)
    return out


RAYS = 32  # rays around the robot, the first one straight ahead, counter-clockwise


def ray_distances(
    origin: Floats, heading: Floats, circles: Floats, radius: float, sides: Floats, limit: float
) -> Floats:
    """Measure the distance [B, 32] in m to the first circle or side on each ray, at most `limit`; 0
    inside a circle.

    Args:
        origin: [B, 2] in m.
        heading: [B] direction of the first ray in rad.
        circles: [B, K, 2] centres, all of one `radius` in m.
        sides: [V, 2, 2] start and end points of walls.
        limit: in m.
    """
    angle = heading[:, None] + np.arange(RAYS) * (2.0 * np.pi / RAYS)
    ux, uy = np.cos(angle), np.sin(angle)
    return np.minimum(
        _to_circles(origin, ux, uy, circles, radius, limit), _to_sides(origin, ux, uy, sides, limit)
    )


def _to_circles(
    origin: Floats, ux: Floats, uy: Floats, circles: Floats, radius: float, limit: float
) -> Floats:
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
    px, py = (
        (start[:, 0] - origin[:, None, 0])[:, None],
        (start[:, 1] - origin[:, None, 1])[:, None],
    )
    ux, uy = ux[..., None], uy[..., None]
    # origin + t u = start + s along
    turn = ux * along[:, 1] - uy * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (px * along[:, 1] - py * along[:, 0]) / turn
        s = (px * uy - py * ux) / turn
        hit = (t >= 0.0) & (s >= 0.0) & (s <= 1.0)
    nearest: Floats = np.where(hit, t, limit).min(axis=-1)
    return np.minimum(nearest, limit)


BOUND = 3.0  # bound of every entry of the privileged vector

MOTION_AND_GOAL = 7


def motion_and_goal(
    velocity: Floats, turn: Floats, xy: Floats, heading: Floats, goal: Floats
) -> Floats:
    """Join [B, 7]: own velocity (2, m/s), turn rate (3 rad/s), direction of the goal (2), its
    distance / 3 m and exp(-distance / 1 m).

    Vectors are in the frame whose x axis is the robot's front.

    Args:
        velocity: [B, 2] world velocity in m/s.
        turn: [B] rad/s.
        xy: [B, 2] in m.
        heading: [B] of the robot's front in rad.
        goal: [B, 2] in m.
    """
    own = to_body(velocity[:, None], np.zeros_like(velocity), heading)[:, 0]
    target = to_body(goal[:, None], xy, heading)[:, 0]
    apart = np.sqrt(target[:, :1] ** 2 + target[:, 1:] ** 2)
    return np.concatenate(
        [own, turn[:, None] / 3.0, target / np.maximum(apart, 1e-9), apart / 3.0, np.exp(-apart)],
        axis=1,
    )


def nearness(distances: Floats) -> Floats:
    """Turn ray distances [B, 32] in m into numbers that tell most where it matters: 1 at
    contact, 0.37 at 0.5 m, 0.05 at 1.5 m.
    """
    near: Floats = np.exp(-2.0 * distances)
    return near


def bounded(*parts: Floats) -> NDArray[np.float32]:
    """Join parts [B, ...] into one float32 vector [B, P] within the bound."""
    vector: NDArray[np.float32] = np.clip(np.concatenate(parts, axis=1), -BOUND, BOUND).astype(
        np.float32
    )
    return vector
