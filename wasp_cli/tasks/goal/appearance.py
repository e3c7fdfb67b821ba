"""What Goal looks like: a checker floor under a black sky, a translucent goal, blue discs, a
cyan cube.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from wasp_cli.tasks.camera.appearance import Appearance, Kind, Painter, Part, Shades
from wasp_cli.tasks.camera.frame import column
from wasp_cli.tasks.goal import model

CAMERA_HEIGHT = 0.15  # above the body's origin, in m
TILE_DARK = (0.859, 0.843, 0.765)
TILE_LIGHT = (0.949, 0.914, 0.855)
TILE_SIDE = 0.35  # in m
SPHERE_COLOUR = (0.7412, 0.0431, 0.1843)
ARROW_COLOUR = (0.0039, 0.1529, 0.3961)
VASE_COLOUR = (0.0, 1.0, 1.0)
GOAL_COLOUR = (0.0, 1.0, 0.0)
HAZARD_COLOUR = (0.0, 0.0, 1.0)
# More opaque than the reference package (0.25): far hazards and goals are a few pixels at 64 x 64
# and would vanish from the latent.
GOAL_ALPHA = 0.7
HAZARD_ALPHA = 0.7
GOAL_RADIUS = 0.3  # in m
GOAL_HALF_HEIGHT = 0.15
HAZARD_HALF_HEIGHT = 0.01
MAP_HALF_SIDES = (1.5, 2.0, 2.5)  # by level, in m: half a metre more than where things are placed


class Checker:
    """Squares of two colours, whose edges are as wide as a pixel; squares smaller than a pixel
    fade into their mean.
    """

    _mean = (column(TILE_LIGHT) + column(TILE_DARK)) * np.float32(0.5)
    _amplitude = (column(TILE_LIGHT) - column(TILE_DARK)) * np.float32(0.5)

    def painter(self, footprint: Shades) -> Painter:
        """Return what paints [m] places, smoothed over `footprint` [m] in m."""
        sharpness: Shades = np.divide(
            np.float32(4.0 * TILE_SIDE), np.maximum(footprint, np.float32(1e-6))
        )
        visible = np.clip(
            np.float32(2.0) - footprint * np.float32(2.0 / TILE_SIDE),
            np.float32(0.0),
            np.float32(1.0),
        )

        def paint(x: Shades, y: Shades) -> Shades:
            mix = _wave(x, sharpness)
            mix *= _wave(y, sharpness)
            mix *= visible
            image: Shades = self._amplitude * mix
            image += self._mean
            return image

        return paint


def _wave(place: Shades, sharpness: Shades) -> Shades:
    """A square wave of period two tiles."""
    phase = place * np.float32(0.5 / TILE_SIDE)
    phase += np.float32(0.25)
    phase -= np.floor(phase)
    phase -= np.float32(0.5)
    np.abs(phase, out=phase)
    wave: Shades = np.subtract(np.float32(0.25), phase, out=phase)
    wave *= sharpness
    np.maximum(wave, np.float32(-1.0), out=wave)
    np.minimum(wave, np.float32(1.0), out=wave)
    return wave


@lru_cache
def appearance(level: int) -> Appearance:
    """Return the appearance of level 0 (only a goal), 1, or 2 (more things on a larger square)."""
    goal = Kind(
        "goal",
        f'<geom type="cylinder" size="{GOAL_RADIUS} {GOAL_HALF_HEIGHT}"/>',
        GOAL_COLOUR,
        GOAL_ALPHA,
    )
    disc = f'<geom type="cylinder" size="{model.HAZARD_RADIUS} {HAZARD_HALF_HEIGHT}"/>'
    hazard = Kind("hazard", disc, HAZARD_COLOUR, HAZARD_ALPHA, painted=model.HAZARD_RADIUS)
    vase = Kind("vase", model.VASE_GEOM, VASE_COLOUR)
    return Appearance(
        robot=(Part(model.SPHERE_GEOM, SPHERE_COLOUR), Part(model.ARROW_GEOM, ARROW_COLOUR)),
        camera_height=CAMERA_HEIGHT,
        forward=(1.0, 0.0),
        floor=Checker(),
        walls=(),
        landmarks=(),
        kinds=(goal,) if level == 0 else (goal, hazard, vase),
        map_half_side=MAP_HALF_SIDES[level],
    )
