"""What Race looks like: a cobbled lane between a brown fence and a grey rock, dark bushes to
avoid and a pink one to reach.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from wasp_cli.tasks.camera.appearance import (
    Appearance,
    Colour,
    Kind,
    Landmark,
    Painter,
    Shades,
    Wall,
)
from wasp_cli.tasks.car import CAMERA_HEIGHT, CAR_PARTS, FORWARD
from wasp_cli.tasks.race.model import SCENERY, Prism


class _Paint(NamedTuple):
    """How a kind of prism is painted."""

    colours: tuple[Colour, Colour]
    stripe: float  # length in m


_PAINTS = {
    "fence": _Paint(((0.40, 0.24, 0.10), (0.62, 0.42, 0.22)), 0.25),
    "rock": _Paint(((0.36, 0.37, 0.40), (0.50, 0.51, 0.53)), 0.4),
    "door": _Paint(((0.30, 0.14, 0.06), (0.42, 0.22, 0.10)), 0.2),
    "stone": _Paint(((0.62, 0.62, 0.60), (0.72, 0.72, 0.70)), 0.2),
}
"""By kind of prism."""

# The lane looks the same in both directions. What stands beyond its ends tells them apart: red
# where the goal is, blue at the start.
_LANDMARKS = (
    Landmark((7.0, 1.05), 0.4, 3.0, (0.90, 0.10, 0.08)),
    Landmark((-6.0, 1.05), 0.5, 5.0, (0.10, 0.20, 0.90)),
)


class Cobbles:
    """Rows of stones in two tints with dark joints; what is smaller than a pixel fades into its
    mean.
    """

    side = 0.35
    _joint = 0.06  # width of a joint as a share of a stone
    _mean = np.array([[0.47], [0.44], [0.40]], np.float32)
    _amplitude = np.array([[0.05], [0.05], [0.055]], np.float32)

    def painter(self, footprint: Shades) -> Painter:
        """Return what paints [m] places, smoothed over `footprint` [m] in m."""
        width = footprint * np.float32(1.0 / self.side)
        blur = np.float32(self._joint) + width
        visible = np.clip(
            np.float32(2.0) - np.float32(2.0) * width, np.float32(0.0), np.float32(1.0)
        )

        def paint(x: Shades, y: Shades) -> Shades:
            across = y * np.float32(1.0 / self.side)
            row = np.floor(across)
            # Every other row is shifted by half a stone, as masons lay them.
            along = x * np.float32(1.0 / self.side)
            along += row * np.float32(0.5)
            stone = np.floor(along)
            across -= row
            along -= stone
            stone += row
            stone *= np.float32(0.5)
            mix = np.where(stone > np.floor(stone), np.float32(1.0), np.float32(-1.0))
            # Distance to the nearest joint, in stones; a joint is as dark as it fills the pixel.
            edge = np.minimum(
                np.minimum(along, np.float32(1.0) - along),
                np.minimum(across, np.float32(1.0) - across),
            )
            mix -= np.float32(3.0) * np.clip((blur - edge) / blur, np.float32(0.0), np.float32(1.0))
            mix *= visible
            image: Shades = self._amplitude * mix
            image += self._mean
            return image

        return paint


def _bush(radius: float, height: float, knobs: float) -> str:
    """MJCF of a dome with four knobs that make it look the same from no two sides."""
    geoms = f'<geom type="ellipsoid" size="{radius} {radius} {height}"/>'
    for x, y in ((0.19, 0.05), (-0.07, 0.18), (-0.16, -0.12), (0.1, -0.17)):
        geoms += f'<geom type="sphere" size="0.13" pos="{x} {y} {knobs}"/>'
    return geoms


def _wall(prism: Prism) -> Wall:
    paint = _PAINTS[prism.kind]
    return Wall(prism.outline, prism.top, paint.colours, paint.stripe)


@lru_cache
def appearance(level: int) -> Appearance:
    """Return the appearance of level 0 (only a goal) or higher."""
    goal = Kind("goal", _bush(0.36, 0.28, 0.18), (1.0, 0.25, 0.62))
    hazard = Kind("hazard", _bush(0.28, 0.22, 0.1), (0.05, 0.36, 0.08))
    return Appearance(
        robot=CAR_PARTS,
        camera_height=CAMERA_HEIGHT,
        forward=FORWARD,
        floor=Cobbles(),
        walls=tuple(_wall(prism) for prism in SCENERY),
        landmarks=_LANDMARKS,
        kinds=(goal,) if level == 0 else (goal, hazard),
        map_half_side=3.6,
        map_centre=(0.2, 0.6),
        # A bright sky: the walls' tops and the landmarks stand out against it.
        horizon=(0.66, 0.75, 0.85),
        zenith=(0.38, 0.54, 0.80),
        haze=25.0,
    )
