"""The pseudo lidar of the reference package: bins around the agent that light up with the nearness of object centres."""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats

BINS = 16
RANGE = 3.0
"""Distance in m from which an object is no longer seen."""


def to_body(points: Floats, origin: Floats, yaw: Floats) -> Floats:
    """World points [B, K, 2] in body frames at `origin` [B, 2] turned by `yaw` [B] -> [B, K, 2]."""
    offset = points - origin[:, None, :]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = offset[..., 0], offset[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def lidar(points: Floats) -> Floats:
    """Nearness in [0, 1] per bin -> [B, 16], of object centres [B, K, 2] given in the body frame.

    Bin 0 starts at body +x, counter-clockwise. An object lights its own bin by s, and the neighbours by how near it is to their edge.
    """
    batch, count, _ = points.shape
    x, y = points[..., 0], points[..., 1]
    nearness = np.maximum(0.0, RANGE - np.hypot(x, y)) / RANGE
    place = np.mod(np.arctan2(y, x), 2.0 * np.pi) / (2.0 * np.pi / BINS)
    floor = np.floor(place)
    fraction = place - floor
    # mod of a tiny negative angle rounds to 2 pi itself, hence the second mod.
    bins = floor.astype(np.intp) % BINS
    out = np.zeros((batch, BINS))
    rows = np.arange(batch)
    for k in range(count):
        own, s, f = bins[:, k], nearness[:, k], fraction[:, k]
        for target, value in ((own, s), ((own + 1) % BINS, f * s), ((own - 1) % BINS, (1.0 - f) * s)):
            out[rows, target] = np.maximum(out[rows, target], value)
    return out
