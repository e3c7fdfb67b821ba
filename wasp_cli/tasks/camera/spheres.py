"""Spheres around things, and the pixels that may show them: whatever is outside of these needs no look."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats
from wasp_cli.tasks.camera.appearance import Kind


def bounding_spheres(kind: Kind) -> tuple[Floats, Floats]:
    """Return centres [1 + G, 3] in the kind's body frame and radii [1 + G] in m: of the whole thing, then of each of its G geoms."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{kind.geoms}</worldbody></mujoco>")
    centres, radii = model.geom_pos, model.geom_rbound
    middle = ((centres - radii[:, None]).min(axis=0) + (centres + radii[:, None]).max(axis=0)) / 2.0
    whole = (np.sqrt(((centres - middle) ** 2).sum(axis=1)) + radii).max()
    return np.concatenate([middle[None], centres]), np.concatenate([[whole], radii]) + 1e-6


def rectangles(axes: Floats, centres: Floats, radii: Floats | float) -> tuple[Bools, NDArray[np.intp]]:
    """Find where cameras with `axes` [m, 2, 3, 3] in the world see spheres: `radii` [m] in m, `centres` [m, 3] relative to the cameras.

    Returns:
        Whether any pixel can show it [2, m], and the first and last-plus-one row and column [2, m, 4] of those that can.
    """
    x, y, z = centres.T[:, None, None]
    axes = np.moveaxis(axes, 0, -1)
    ahead, right, up = np.moveaxis(axes[:, :, 0] * x + axes[:, :, 1] * y + axes[:, :, 2] * z, 0, 1)
    half = CAMERA_SIZE / 2
    bottom, top = _span(ahead, up, radii)
    left, right_end = _span(ahead, right, radii)
    # A pixel of slack: a candidate too many costs a ray, one too few would cut the thing.
    edges = np.stack([(1.0 - top) * half, (1.0 - bottom) * half, (left + 1.0) * half, (right_end + 1.0) * half], axis=-1)
    edges += [-1.0, 1.0, -1.0, 1.0]
    inner = np.clip(edges, 0, CAMERA_SIZE).astype(np.intp)
    seen = (ahead > -radii) & (inner[..., 0] < inner[..., 1]) & (inner[..., 2] < inner[..., 3])
    return seen, inner


def _span(ahead: Floats, across: Floats, radii: Floats | float) -> tuple[Floats, Floats]:
    """Least and greatest across / ahead at which spheres are seen: of the tangents to their outlines, where they lie ahead."""
    radii2 = radii * radii
    reach = radii * np.sqrt(np.maximum(across * across + ahead * ahead - radii2, 0.0))
    beside, clear, mixed = across * across - radii2, ahead * ahead - radii2, across * ahead
    with np.errstate(divide="ignore", invalid="ignore"):
        # Twice the same quotient, once in the form that holds beside the camera and once in that which holds ahead of it.
        low = np.where(across > radii, beside / (mixed + reach), np.where(ahead > radii, (mixed - reach) / clear, -1e3))
        high = np.where(across < -radii, beside / (mixed - reach), np.where(ahead > radii, (mixed + reach) / clear, 1e3))
    return low, high
