"""The pseudo lidar of the reference package: bins around the agent that light up with the nearness of object centres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wasp_cli.tasks.base import Floats

BINS = 16
RANGE = 3.0
"""Distance in m from which an object is no longer seen."""


def lidars(points: Floats, sizes: Sequence[int]) -> Floats:
    """Nearness in [0, 1] per bin -> [B, 16 J], of the centres [B, K, 2] of J kinds of objects, given in the body frame.

    Bin 0 starts at body +x, counter-clockwise. An object lights its own bin by s, and the neighbours by how near it is to their edge.

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
    place = np.mod(np.arctan2(y[rows, columns], x[rows, columns]), 2.0 * np.pi) / (2.0 * np.pi / BINS)
    floor = np.floor(place)
    # mod of a tiny negative angle rounds to 2 pi itself, hence the second mod.
    own, s, f = floor.astype(np.intp) % BINS, nearness[rows, columns], place - floor
    for target, value in ((own, s), ((own + 1) % BINS, f * s), ((own - 1) % BINS, (1.0 - f) * s)):
        np.maximum.at(out, (rows, first + target), value)
    return out
