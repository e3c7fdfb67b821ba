"""One image pair while it is being drawn. P = 2 * 64 * 64 pixels, front image first; m = some of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.camera.look import Colour, Scene, Shades
from wasp_cli.tasks.camera.rays import View

_LOWEST = 0.02
"""Height in m below which no camera sinks, even that of a car on its back."""


class Frame(NamedTuple):
    """The cameras in the world, and what was drawn so far."""

    origin: Floats
    """[3] where both cameras are."""
    axes: Floats
    """[2, 3, 3] for each camera its forward, right and up unit vectors."""
    rays: Shades
    """[3, P] unit vectors."""
    depth: Shades
    """[P] distance in m of what is seen; FAR in the sky."""
    image: Shades
    """[3, P] in [0, 1]; nothing is in it at first."""

    def put(self, pixels: NDArray[np.intp], colours: Shades) -> None:
        """Enter colours [3, m] at pixels [m]."""
        put(self.image, pixels, colours)


def open_frame(view: View, camera_height: float, scene: Scene, row: int) -> Frame:
    """The cameras of one row, of which nothing was drawn but the depth of the robot's own body."""
    turn = rounded(scene.rotation[row])
    origin = rounded(scene.position[row]) + turn[:, 2] * camera_height
    origin[2] = max(origin[2], _LOWEST)
    axes = view.axes[..., 0, None] * turn[:, 0] + view.axes[..., 1, None] * turn[:, 1] + view.axes[..., 2, None] * turn[:, 2]
    x, y, z = turn.astype(np.float32).T[:, :, None]
    rays = x * view.rays[0]
    rays += y * view.rays[1]
    rays += z * view.rays[2]
    return Frame(origin, axes, rays, view.depth.copy(), np.empty_like(rays))


def put(image: Shades, pixels: NDArray[np.intp], colours: Shades) -> None:
    """Enter colours [3, m] at pixels [m] of an image: by channel, which is three times as fast as an assignment to all of them."""
    for channel, colour in zip(image, colours, strict=True):
        channel[pixels] = colour


def rounded(values: Floats) -> Floats:
    """To float32 and back: differences of the last bits between machines are gone, the arithmetic stays in float64."""
    return values.astype(np.float32).astype(np.float64)


def column(rgb: Colour) -> Shades:
    """[3, 1]"""
    return np.array(rgb, np.float32)[:, None]
