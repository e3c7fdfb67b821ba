"""Spheres around things, and the pixels that may show them: no other pixel needs a ray. m =
spheres, each with a camera pair of its own.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats
from wasp_cli.tasks.camera.appearance import Kind


def bounding_spheres(kind: Kind) -> tuple[Floats, Floats]:
    """Return centres [1 + G, 3] in the kind's body frame and radii [1 + G] in m: of the whole
    thing, then of each of its G geoms.
    """
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{kind.geoms}</worldbody></mujoco>")
    centres = model.geom_pos
    radii = model.geom_rbound
    # Around the whole thing: in the middle of the box that holds the spheres of the geoms.
    low = (centres - radii[:, None]).min(axis=0)
    high = (centres + radii[:, None]).max(axis=0)
    middle = (low + high) / 2.0
    whole = (np.sqrt(((centres - middle) ** 2).sum(axis=1)) + radii).max()
    all_centres = np.concatenate([middle[None], centres])
    all_radii = np.concatenate([[whole], radii]) + 1e-6
    return all_centres, all_radii


def rectangles(axes: Floats, centres: Floats, radii: Floats) -> tuple[Bools, NDArray[np.intp]]:
    """Find where cameras with `axes` [m, 2, 3, 3] in the world see spheres: `radii` [m] in m,
    `centres` [m, 3] relative to the cameras.

    Returns:
        Whether any pixel can show it [m, 2], and the first and last-plus-one row and column [m, 2,
        4] of those that can.
    """
    # What is found here decides only which pixels are looked at, so that the last bits of a product
    # do not count.
    # Centres in the cameras' frames: forward, and up and right.
    local = (axes @ centres[:, None, :, None])[..., 0]
    ahead = local[..., :1]
    across = local[..., :0:-1]
    radius = radii[:, None, None]
    radius2 = radius * radius
    # Least and greatest across / ahead, of up and right, at which spheres are seen: of the tangents
    # to their outlines, if those lie ahead. They solve a quadratic equation:
    # clear q^2 - 2 mixed q + beside = 0.
    clear = ahead * ahead - radius2
    beside = across * across - radius2
    mixed = across * ahead
    reach = radius * np.sqrt(np.maximum(beside + ahead * ahead, 0.0))
    before = ahead > radius
    with np.errstate(divide="ignore", invalid="ignore"):
        # Twice the same quotient, once in the form that holds beside the camera and once in that
        # which holds ahead of it.
        low = np.where(
            across > radius,
            beside / (mixed + reach),
            np.where(before, (mixed - reach) / clear, -1e3),
        )
        high = np.where(
            across < -radius,
            beside / (mixed - reach),
            np.where(before, (mixed + reach) / clear, 1e3),
        )
    # First and last row count from the top. A pixel of slack: one too many costs a ray, one too few
    # would cut the thing.
    edges = np.empty((*ahead.shape[:2], 4))
    edges[..., 0] = -high[..., 0]
    edges[..., 1] = -low[..., 0]
    edges[..., 2] = low[..., 1]
    edges[..., 3] = high[..., 1]
    edges += _MIDDLE
    edges *= CAMERA_SIZE / 2
    inner = np.minimum(np.maximum(edges, 0.0), CAMERA_SIZE).astype(np.intp)
    has_pixels = (inner[..., ::2] < inner[..., 1::2]).all(axis=-1)
    seen = (ahead[..., 0] > -radii[:, None]) & has_pixels
    return seen, inner


_MIDDLE = 1.0 + np.array([-1.0, 1.0, -1.0, 1.0]) / (CAMERA_SIZE / 2)
"""What turns a tangent in [-1, 1] into half images from the left or top, with a pixel of slack."""
