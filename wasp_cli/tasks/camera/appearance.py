"""What a task looks like; `camera` and `topdown` draw it. n = episodes drawn, K = things of one
kind in each.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Bools, Floats

Colour = tuple[float, float, float]  # red, green, blue in [0, 1]
Shades = NDArray[np.float32]


class Things(NamedTuple):
    """Where the things of one kind are, world frame."""

    position: Floats  # [n, K, 3] origin of the kind's body frame
    rotation: Floats  # [n, K, 3, 3] body to world
    shown: Bools  # [n, K]


def standing(xy: Floats, z: float = 0.0) -> Things:
    """Return upright things at places [n, K, 2] and the height `z`, in m, all of them shown."""
    height = np.full((*xy.shape[:-1], 1), z)
    return Things(
        position=np.concatenate([xy, height], axis=-1),
        rotation=np.broadcast_to(np.eye(3), (*xy.shape[:2], 3, 3)),
        shown=np.ones(xy.shape[:2], np.bool_),
    )


class Scene(NamedTuple):
    """What there is to see in n episodes."""

    position: Floats  # [n, 3] origin of the robot's body frame, world
    rotation: Floats  # [n, 3, 3] robot body to world
    things: dict[str, Things]  # by the names of `Appearance.kinds`


class Kind(NamedTuple):
    """One kind of movable thing: geoms in a body frame, all of one colour."""

    name: str
    geoms: str  # MJCF of its geoms, without colours
    colour: Colour
    alpha: float = 1.0
    painted: float | None = None
    """Radius of a flat disc that is painted onto the floor instead of cast as a solid; the
    geoms are then not drawn by the camera.
    """
    column: tuple[float, float] | None = None
    """Radius and height of an upright column that is drawn instead of the geoms, from any
    distance at least a pixel wide.
    """
    # distance in m beyond which it is not drawn, being smaller than a pixel; None: no limit
    reach: float | None = None


class Part(NamedTuple):
    """One geom of the robot itself, in its body frame."""

    geom: str  # MJCF of the geom
    colour: Colour


class Wall(NamedTuple):
    """An upright solid that never moves."""

    outline: Floats  # [V, 2] closed ring
    top: float  # height in m; it reaches down to the floor
    # alternating along the wall, so that motion along it can be seen
    colours: tuple[Colour, Colour]
    stripe: float = 0.5  # length of one stripe in m
    hollow: bool = False  # the ring is a face around free space, with the solid outside of it


class Landmark(NamedTuple):
    """A tall thin tower beyond reach: something to tell places and directions by."""

    xy: tuple[float, float]
    radius: float
    top: float  # height in m
    colour: Colour


Painter = Callable[[Shades, Shades], Shades]  # colours float32 [3, m] at world places x, y [m] in m


class Floor(Protocol):
    """The colours of the ground."""

    def painter(self, footprint: Shades) -> Painter:
        """Return what paints pixels that are `footprint` [m] in m on the ground, smoothed over
        that: nothing may flicker far away.
        """
        ...


class Appearance(NamedTuple):
    """Everything that stays the same over the episodes of a task."""

    robot: tuple[Part, ...]
    camera_height: float  # of both cameras above the body's origin, along the body's z axis, in m
    # the front camera's heading in the body frame; the rear camera looks the other way
    forward: tuple[float, float]
    floor: Floor
    walls: tuple[Wall, ...]
    landmarks: tuple[Landmark, ...]
    kinds: tuple[Kind, ...]
    map_half_side: float  # half the side of the map from above in m
    map_centre: tuple[float, float] | None = None
    """Centre of the map; None: it follows the robot when it would leave a map around the origin."""
    horizon: Colour = (0.012, 0.012, 0.02)
    """Of the sky straight ahead, into which floor and walls fade with distance. Nearly black in
    the reference package.
    """
    zenith: Colour = (0.012, 0.012, 0.02)  # of the sky above
    # distance in m at which half of the colour of floor and walls is left. Things and landmarks do
    # not fade.
    haze: float = 12.0


@runtime_checkable
class HasScene(Protocol):
    """A task that can be drawn for people (`wasp_cli.tasks.camera.topdown`). No picture of
    these is an observation.
    """

    def appearance(self) -> Appearance:
        """Return what stays the same over the episodes."""
        ...

    def scene(self, rows: NDArray[np.intp]) -> Scene:
        """Return where everything is now, of `rows` [n]."""
        ...
