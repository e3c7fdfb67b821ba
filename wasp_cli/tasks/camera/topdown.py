"""A map from above, for videos and figures. Plain numpy; nothing in it is an observation."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import MAP_SIZE, Bools, Floats, Pixels
from wasp_cli.tasks.camera.appearance import Appearance, Colour, HasScene, Kind, Scene
from wasp_cli.tasks.camera.raster import around as window_around
from wasp_cli.tasks.camera.raster import filled, near_sides
from wasp_cli.tasks.outline import segments

# On a map of a whole track things are smaller than a pixel: as shares of the map's half side, what
# they are drawn as at least.
LEAST_ROBOT = 0.045
LEAST_GOAL = 0.02
LEAST_THING = 0.005
_MARGIN = 0.2  # how close in m the robot may come to the border of a map that follows it
_HEADING_COLOUR = (1.0, 1.0, 1.0)
_TRANSLUCENT = 0.45


class Shape(NamedTuple):
    """The outline of a geom from above, in its body's frame."""

    round: bool
    centre: Floats  # [2]
    axes: Floats  # [2, 2] unit vectors along its two sides
    half: Floats  # [2] half its sides; of a round one twice its radius


class _Canvas:
    """An image with its place in the world."""

    def __init__(self, centre: Floats, half_side: float, size: int) -> None:
        at = ((np.arange(size) + 0.5) / size * 2.0 - 1.0) * half_side
        self.x = centre[0] + at  # of the columns
        self.y = centre[1] - at  # of the rows, from the top
        self.centre = centre
        self.half_side = half_side
        self.pixel = 2.0 * half_side / size
        self.image = np.zeros((size, size, 3))

    def shape(
        self,
        shape: Shape,
        origin: Floats,
        axes: Floats,
        colour: Colour,
        alpha: float = 1.0,
        scale: float = 1.0,
    ) -> None:
        """Fill a shape of a body at `origin` [2] with body axes `axes` [2, 2] (rows: where body
        x and y point).
        """
        centre = origin + scale * (shape.centre @ axes)
        along_side, across_side = shape.axes @ axes
        half = shape.half * scale
        extent = float(half[0] + half[1])
        rows, columns = window_around(self.x, self.y, centre - extent, centre + extent)
        dx = self.x[columns] - centre[0]
        dy = (self.y[rows] - centre[1])[:, None]
        along = dx * along_side[0] + dy * along_side[1]
        across = dx * across_side[0] + dy * across_side[1]
        if shape.round:
            inside = along**2 + across**2 < half[0] * half[1]
        else:
            inside = (np.abs(along) < half[0]) & (np.abs(across) < half[1])
        self._blend((rows, columns), inside, colour, alpha)

    def in_view(self, places: Floats, extent: float) -> Bools:
        """Tell whether something of `extent` m may show at places [K, 2]; most of a long track
        is beyond a map that follows the robot.
        """
        near: Bools = np.abs(places - self.centre).max(axis=1) <= self.half_side + extent
        return near

    def disc(self, centre: Floats, radius: float, colour: Colour, alpha: float = 1.0) -> None:
        """Fill a disc around `centre` [2]; lengths in m."""
        self.shape(disc(radius), centre, np.eye(2), colour, alpha)

    def triangle(self, corners: Floats, colour: Colour) -> None:
        """Fill the triangle `corners` [3, 2] in m."""
        rows, columns = window_around(self.x, self.y, corners.min(axis=0), corners.max(axis=0))
        self._blend((rows, columns), filled(corners, self.x[columns], self.y[rows]), colour, 1.0)

    def _blend(
        self, window: tuple[slice, slice], inside: NDArray[np.bool_], colour: Colour, alpha: float
    ) -> None:
        """Mix a colour into the pixels of a window that are `inside` [h, w]."""
        view = self.image[window]
        view[inside] = (1.0 - alpha) * view[inside] + alpha * np.array(colour)


def from_above(task: HasScene, row: int, size: int = MAP_SIZE) -> Pixels:
    """Draw one episode of a task as a map: uint8 [size, size, 3], +x to the right, +y up."""
    return draw_map(task.appearance(), task.scene(np.array([row])), 0, size)


def draw_map(
    appearance: Appearance,
    scene: Scene,
    row: int,
    size: int,
    around: tuple[tuple[float, float], float] | None = None,
) -> Pixels:
    """Draw one row of a scene as a map: uint8 [size, size, 3], +x to the right, +y up.

    Args:
        appearance: of the task.
        scene: n rows.
        row: which of them.
        size: side of the map in pixels.
        around: centre and half side of the map in m, instead of the appearance's own.
    """
    position = scene.position[row, :2]
    forward = scene.rotation[row, :2, :2] @ np.array(appearance.forward)
    half_side = appearance.map_half_side if around is None else around[1]
    if around is not None:
        centre = np.array(around[0])
    elif appearance.map_centre is not None:
        centre = np.array(appearance.map_centre)
    else:
        centre = position - np.clip(position, _MARGIN - half_side, half_side - _MARGIN)
    canvas = _Canvas(centre, half_side, size)
    _draw_ground(canvas, appearance)
    _draw_things(canvas, appearance, scene, row, half_side)
    _draw_robot(canvas, appearance, position, forward, half_side)
    out: Pixels = (np.clip(canvas.image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return out


def _draw_ground(canvas: _Canvas, appearance: Appearance) -> None:
    """Draw floor, walls and landmarks."""
    all_x, all_y = np.meshgrid(canvas.x, canvas.y)
    x = all_x.ravel().astype(np.float32)
    y = all_y.ravel().astype(np.float32)
    paint = appearance.floor.painter(np.full(x.shape, canvas.pixel, np.float32))
    colours = paint(x, y)
    canvas.image[:] = colours.T.reshape(canvas.image.shape)
    for wall in appearance.walls:
        first = np.array(wall.colours[0])
        second = np.array(wall.colours[1])
        if not wall.hollow:
            canvas.image[filled(wall.outline, canvas.x, canvas.y)] = (first + second) / 2.0
        width = max(0.05, 0.75 * canvas.pixel)
        for side in near_sides(segments(wall.outline), canvas.x, canvas.y, width):
            canvas.image[side.window][side.distance < width] = first
    for mark in appearance.landmarks:
        canvas.disc(np.array(mark.xy), max(mark.radius, 1.5 * canvas.pixel), mark.colour)


def _draw_things(
    canvas: _Canvas, appearance: Appearance, scene: Scene, row: int, half_side: float
) -> None:
    """Draw the things of all kinds, at least as large as they have to be on this map."""
    for kind in sorted(appearance.kinds, key=_drawing_order):
        things = scene.things[kind.name]
        shapes = shapes_of(kind.geoms) if kind.column is None else (disc(kind.column[0]),)
        least = half_side * (LEAST_GOAL if kind.name == "goal" else LEAST_THING)
        scale = max(1.0, least / _extent(shapes))
        alpha = _TRANSLUCENT if kind.alpha < 1.0 else 1.0
        places = things.position[row, :, :2]
        visible = things.shown[row] & canvas.in_view(places, 1.5 * scale * _extent(shapes))
        for thing in np.flatnonzero(visible):
            axes = _ground_axes(things.rotation[row, thing])
            for shape in shapes:
                canvas.shape(shape, places[thing], axes, kind.colour, alpha, scale)


def _drawing_order(kind: Kind) -> tuple[bool, bool, bool]:
    """What is painted onto the floor comes first, then what is translucent, and goals last."""
    return kind.painted is None, kind.alpha == 1.0, kind.name == "goal"


def _draw_robot(
    canvas: _Canvas, appearance: Appearance, position: Floats, forward: Floats, half_side: float
) -> None:
    """Draw the robot at `position` [2], and a triangle from it along `forward` [2]."""
    parts = [(shapes_of(part.geom), part.colour) for part in appearance.robot]
    extent = max(_extent(shapes) for shapes, _ in parts)
    scale = max(1.0, half_side * LEAST_ROBOT / extent)
    forward = forward / max(float(np.hypot(*forward)), 1e-9)
    left = np.array([-forward[1], forward[0]])
    # Body x and y in the world, from where the body's own forward points.
    fx, fy = appearance.forward
    axes = np.stack([fx * forward - fy * left, fy * forward + fx * left])
    for shapes, colour in parts:
        for shape in shapes:
            canvas.shape(shape, position, axes, colour, 1.0, scale)
    nose = scale * extent
    corners = np.stack(
        [
            nose * forward,
            0.35 * nose * (left - 0.2 * forward),
            -0.35 * nose * (left + 0.2 * forward),
        ]
    )
    canvas.triangle(position + corners, _HEADING_COLOUR)


def _ground_axes(rotation: Floats) -> Floats:
    """[2, 2] where body x and y point on the ground; of a body that lies on its side as if it
    stood.
    """
    x = rotation[:2, 0]
    length = float(np.hypot(*x))
    x = x / length if length > 1e-6 else np.array([1.0, 0.0])
    return np.stack([x, np.array([-x[1], x[0]])])


def disc(radius: float) -> Shape:
    """Return the outline of a disc around the body's origin; `radius` in m."""
    return Shape(True, np.zeros(2), np.eye(2), np.array([radius, radius]))


def _extent(shapes: tuple[Shape, ...]) -> float:
    """How far the shapes reach from the body's origin."""
    reaches = []
    for shape in shapes:
        half = shape.half[0] if shape.round else np.hypot(*shape.half)
        reaches.append(float(np.hypot(*shape.centre) + half))
    return max(reaches)


@lru_cache
def shapes_of(geoms: str) -> tuple[Shape, ...]:
    """Return the outlines from above of MJCF geoms, lowest first."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    shapes = []
    for geom in np.argsort(model.geom_pos[:, 2], kind="stable"):
        axes = data.geom_xmat[geom].reshape(3, 3)
        size = model.geom_size[geom]
        kind = mujoco.mjtGeom(int(model.geom_type[geom]))
        centre = model.geom_pos[geom, :2].copy()
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            shapes.append(Shape(False, centre, axes[:2, :2].T, size[:2].copy()))
        elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER and abs(axes[2, 2]) < 0.5:
            # It lies on its side: a box from above.
            along = axes[:2, 2]
            sides = np.stack([along, np.array([-along[1], along[0]])])
            shapes.append(Shape(False, centre, sides, np.array([size[1], size[0]])))
        else:
            shapes.append(Shape(True, centre, np.eye(2), np.array([size[0], size[0]])))
    return tuple(shapes)
