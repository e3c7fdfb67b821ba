"""Outlines on the ground: closed rings of points, and their distances from places. V = corners,
n = places.
"""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats


def parse_outline(text: str) -> Floats:
    """Read rows of comma-separated numbers, apart by white space -> [V, numbers in a row]."""
    rows = [row.split(",") for row in text.split()]
    return np.array(rows, np.float64)


def segments(*rings: Floats) -> Floats:
    """Return the sides of closed rings, each [V, 2], one after the other: their start and end
    points [sum of V, 2, 2].
    """
    return np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings])


def distance_to_segments(places: Floats, sides: Floats) -> Floats:
    """Measure the distance of every place [n, 2] from every side [V, 2, 2] -> [n, V], in their
    unit.
    """
    start = sides[:, 0]
    along = sides[:, 1] - sides[:, 0]
    offset = places[:, None, :] - start
    length2 = np.maximum(along[:, 0] ** 2 + along[:, 1] ** 2, 1e-18)
    # The share of each side at which it is nearest.
    projection = offset[..., 0] * along[:, 0] + offset[..., 1] * along[:, 1]
    share = np.clip(projection / length2, 0.0, 1.0)
    dx = offset[..., 0] - share * along[:, 0]
    dy = offset[..., 1] - share * along[:, 1]
    distance: Floats = np.sqrt(dx * dx + dy * dy)
    return distance


def inside(places: Floats, ring: Floats) -> np.ndarray:
    """Tell whether places [n, 2] lie within a closed ring [V, 2] -> bool [n], by the parity of
    crossings.
    """
    x = places[:, 0, None]
    y = places[:, 1, None]
    x0 = ring[:, 0]
    y0 = ring[:, 1]
    x1 = np.roll(x0, -1)
    y1 = np.roll(y0, -1)
    # Sides that a line along x through the place crosses, and where on it.
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    crossings = np.count_nonzero(crosses & (x < at), axis=1)
    return np.asarray(crossings % 2 == 1)
