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
    lidar = np.zeros((len(points), BINS * len(sizes)))
    x = points[..., 0]
    y = points[..., 1]
    # Objects in range, and how near each of them is.
    nearness = np.maximum(0.0, RANGE - np.hypot(x, y)) / RANGE
    rows, columns = np.nonzero(nearness)
    if not rows.size:
        return lidar
    s = nearness[rows, columns]
    # The place of each on the circle, in bins: its own bin, and the share `f` of that behind it.
    angle = np.mod(np.arctan2(y[rows, columns], x[rows, columns]), 2.0 * np.pi)
    place = angle / (2.0 * np.pi / BINS)
    floor = np.floor(place)
    f = place - floor
    # mod of a tiny negative angle rounds to 2 pi itself, hence the second mod.
    own = floor.astype(np.intp) % BINS
    # Of several objects of one kind a bin shows the nearest.
    first = BINS * np.repeat(np.arange(len(sizes)), sizes)[columns]
    np.maximum.at(lidar, (rows, first + own), s)
    np.maximum.at(lidar, (rows, first + (own + 1) % BINS), f * s)
    np.maximum.at(lidar, (rows, first + (own - 1) % BINS), (1.0 - f) * s)
    return lidar


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
    ux = np.cos(angle)
    uy = np.sin(angle)
    to_circles = _to_circles(origin, ux, uy, circles, radius, limit)
    to_sides = _to_sides(origin, ux, uy, sides, limit)
    return np.minimum(to_circles, to_sides)


def _to_circles(
    origin: Floats, ux: Floats, uy: Floats, circles: Floats, radius: float, limit: float
) -> Floats:
    """Distances [B, 32] to circles [B, K, 2] along unit vectors `ux`, `uy` [B, 32]."""
    offset = circles - origin[:, None]
    near = np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2) < limit + radius
    most = int(near.sum(axis=1).max(initial=0))
    if not most:
        return np.full_like(ux, limit)
    # Only those within reach: there are 200 barrels, of which some five are.
    order = np.argsort(~near, axis=1, kind="stable")[:, :most]
    offset = np.take_along_axis(offset, order[..., None], axis=1)
    dx = offset[:, None, :, 0]
    dy = offset[:, None, :, 1]
    # Where a ray passes a circle's centre, how far beside it, and where it enters and leaves.
    along = ux[..., None] * dx + uy[..., None] * dy
    across = ux[..., None] * dy - uy[..., None] * dx
    half_chord2 = radius**2 - across**2
    half_chord = np.sqrt(np.maximum(half_chord2, 0.0))
    entry = along - half_chord
    leave = along + half_chord
    hit = np.where((half_chord2 > 0.0) & (leave > 0.0), np.maximum(entry, 0.0), limit)
    nearest: Floats = np.minimum(hit.min(axis=-1), limit)
    return nearest


def _to_sides(origin: Floats, ux: Floats, uy: Floats, sides: Floats, limit: float) -> Floats:
    """Distances [B, 32] to sides [V, 2, 2] along unit vectors `ux`, `uy` [B, 32]."""
    if not len(sides):
        return np.full_like(ux, limit)
    # Sides out of everybody's reach are left out first.
    low = origin.min(axis=0) - limit
    high = origin.max(axis=0) + limit
    close = ((sides.max(axis=1) >= low) & (sides.min(axis=1) <= high)).all(axis=1)
    sides = sides[close]
    if not len(sides):
        return np.full_like(ux, limit)
    start = sides[:, 0]
    along = sides[:, 1] - sides[:, 0]
    px = (start[:, 0] - origin[:, None, 0])[:, None]
    py = (start[:, 1] - origin[:, None, 1])[:, None]
    ux = ux[..., None]
    uy = uy[..., None]
    # The intersection solves origin + t u = start + s along.
    turn = ux * along[:, 1] - uy * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (px * along[:, 1] - py * along[:, 0]) / turn
        s = (px * uy - py * ux) / turn
        hit = (t >= 0.0) & (s >= 0.0) & (s <= 1.0)
    nearest: Floats = np.where(hit, t, limit).min(axis=-1)
    return np.minimum(nearest, limit)


BOUND = 3.0  # bound of every entry of the privileged vector

MOTION_AND_GOAL = 7  # numbers of `motion_and_goal`


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
    own_velocity = to_body(velocity[:, None], np.zeros_like(velocity), heading)[:, 0]
    target = to_body(goal[:, None], xy, heading)[:, 0]
    apart = np.sqrt(target[:, :1] ** 2 + target[:, 1:] ** 2)
    direction = target / np.maximum(apart, 1e-9)
    return np.concatenate(
        [own_velocity, turn[:, None] / 3.0, direction, apart / 3.0, np.exp(-apart)], axis=1
    )


def nearness(distances: Floats) -> Floats:
    """Return exp(-2 d) of ray distances d [B, 32] in m, which resolves small distances best: 1 at
    contact, 0.37 at 0.5 m, 0.05 at 1.5 m.
    """
    near: Floats = np.exp(-2.0 * distances)
    return near


def bounded(*parts: Floats) -> NDArray[np.float32]:
    """Join parts [B, n] into one float32 vector [B, P], clipped to [-BOUND, BOUND]."""
    joint = np.concatenate(parts, axis=1)
    vector: NDArray[np.float32] = np.clip(joint, -BOUND, BOUND).astype(np.float32)
    return vector
