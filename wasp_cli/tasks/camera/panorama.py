"""What stands upright around a place: for every horizontal direction the nearest wall, its height
and its colour.

Walls and columns are upright, so a picture of them needs no ray per pixel: one look around in the
plane answers for all pixels, which only compare heights. Directions are the points of the square
max(|x|, |y|) = 1, counter-clockwise in N equal steps from its lower right corner: found by
divisions alone, and so to the same bit everywhere. S = sides of outlines, L = layers: a layer hides
only within itself, so that a cliff is seen over a rock.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wasp_cli.tasks.base import CAMERA_SIZE
from wasp_cli.tasks.camera.appearance import Colour, Shades, Wall
from wasp_cli.tasks.camera.frame import column

DIRECTIONS = 512  # N: at least three to the width of a pixel
NOTHING = 1e9  # distance where no side is
_LAYER_RATIO = 2.0  # of heights of walls, from which on they fall into two layers


class Sides(NamedTuple):
    """Upright faces."""

    start: Shades  # [2, S]
    end: Shades  # [2, S]
    top: Shades  # [S]
    layer: NDArray[np.intp]  # [S]
    mean: Shades  # [3, S] mean of the two colours
    amplitude: Shades  # [3, S] half their difference
    stripe: Shades  # [S] length of one stripe
    offset: Shades  # [S] length of the outline before this side, in stripes
    fading: Shades  # [S] at a distance d in m, 1 / (1 + fading d^2) of the colour is left


class Columns(NamedTuple):
    """Upright columns."""

    centre: Shades  # [2, S]
    radius: Shades  # [S]
    top: Shades  # [S]
    colour: Shades  # [3, S]
    layer: NDArray[np.intp]  # [S]


class Panorama(NamedTuple):
    """The nearest side in every direction, for each layer."""

    # [L, N] in units of the direction's vector on the square; NOTHING where there is none
    reach: Shades
    top: Shades  # [L, N]
    colour: Shades  # [3, L * N]


def wall_sides(walls: Sequence[Wall], haze: float) -> tuple[Sides, int]:
    """Return all sides of the walls, and into how many layers they fall: walls of similar height
    share one.

    At the distance `haze` in m half of their colour is left.
    """
    heights = sorted({wall.top for wall in walls})
    layer_of: dict[float, int] = {}
    lowest = 0.0  # wall of the layer
    layers = 0
    for height in heights:
        if height > _LAYER_RATIO * lowest:
            lowest = height
            layers += 1
        layer_of[height] = layers - 1
    if not walls:
        return _no_sides(), layers
    return join([_sides_of(wall, layer_of[wall.top], haze) for wall in walls]), layers


def _sides_of(wall: Wall, layer: int, haze: float) -> Sides:
    """The sides of one wall."""
    start = wall.outline.T
    end = np.roll(start, -1, axis=1)
    length = np.sqrt((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2)
    before = np.concatenate([[0.0], np.cumsum(length)[:-1]]) / wall.stripe
    one = np.ones(start.shape[1], np.float32)
    half = np.float32(0.5)
    first = column(wall.colours[0]) * one
    second = column(wall.colours[1]) * one
    return Sides(
        start=start.astype(np.float32),
        end=end.astype(np.float32),
        top=one * np.float32(wall.top),
        layer=np.full(start.shape[1], layer, np.intp),
        mean=(first + second) * half,
        amplitude=(first - second) * half,
        stripe=one * np.float32(wall.stripe),
        offset=before.astype(np.float32),
        fading=one * np.float32(1.0 / haze**2),
    )


def _no_sides() -> Sides:
    points = np.zeros((2, 0), np.float32)
    colours = np.zeros((3, 0), np.float32)
    numbers = np.zeros(0, np.float32)
    layers = np.zeros(0, np.intp)
    return Sides(
        points, points, numbers, layers, colours, colours, numbers, numbers, fading=numbers
    )


def make_columns(
    places: ArrayLike, shapes: Sequence[tuple[float, float]], colours: Sequence[Colour], layer: int
) -> Columns:
    """Return S columns at `places` [S, 2] with radii and heights `shapes` [S, 2] in m, all in
    one layer.
    """
    count = len(shapes)
    shape = np.array(shapes, np.float32).reshape(count, 2)
    centres = np.asarray(places, np.float32).reshape(count, 2)
    rgb = np.array(colours, np.float32).reshape(count, 3)
    return Columns(
        centre=np.ascontiguousarray(centres.T),
        radius=shape[:, 0],
        top=shape[:, 1],
        colour=np.ascontiguousarray(rgb.T),
        layer=np.full(count, layer, np.intp),
    )


def column_sides(columns: Columns, ox: Shades, oy: Shades) -> Sides:
    """Turn columns into boards at least a pixel wide, each facing its viewer at ox, oy [S] in m."""
    dx = columns.centre[0] - ox
    dy = columns.centre[1] - oy
    distance = np.maximum(np.sqrt(dx * dx + dy * dy), np.float32(1e-6))
    # Five quarters of a pixel at the middle of the image, where a pixel sees the least.
    half = np.maximum(columns.radius, distance * np.float32(1.25 / CAMERA_SIZE)) / distance
    across = np.stack([dy * half, -dx * half])
    return Sides(
        start=columns.centre + across,
        end=columns.centre - across,
        top=columns.top,
        layer=columns.layer,
        mean=columns.colour,
        amplitude=np.zeros_like(columns.colour),
        stripe=np.ones_like(distance),
        offset=np.zeros_like(distance),
        # Columns are there to be found from far away: they do not fade.
        fading=np.zeros_like(distance),
    )


_Parts = TypeVar("_Parts", Sides, Columns)


def join(parts: Sequence[_Parts]) -> _Parts:
    """Concatenate parts along S."""
    first = parts[0]
    if len(parts) == 1:
        return first
    fields = zip(*parts, strict=True)
    return type(first)(*(np.concatenate(field, axis=-1) for field in fields))


def directions(x: Shades, y: Shades) -> tuple[Shades, Shades]:
    """Return where on the square the vectors (x, y) [m] point, in steps: [m] in [0, N], and
    max(|x|, |y|) [m].
    """
    # Which of the four sides of the square, and where on it.
    steep = np.abs(y) > np.abs(x)
    along = np.where(steep, -x, y)
    ahead = np.where(steep, y, x)
    quarter = np.multiply(ahead <= 0, np.float32(2.0))
    quarter += steep
    with np.errstate(divide="ignore", invalid="ignore"):
        along /= ahead
    along += np.float32(1.0)
    along *= np.float32(0.5)
    along += quarter
    along *= np.float32(DIRECTIONS / 4)
    return along, np.abs(ahead, out=ahead)


def _unit_square() -> Shades:
    """The middle [2, N] of each step on the square."""
    at = ((np.arange(DIRECTIONS // 4) + 0.5) / (DIRECTIONS // 8) - 1.0).astype(np.float32)
    one = np.ones_like(at)
    return np.stack([np.concatenate([one, -at, -one, at]), np.concatenate([at, one, -at, -one])])


_TOWARDS = _unit_square()  # [2, N] the middle of each step on the square
_LENGTH = np.sqrt(_TOWARDS[0] * _TOWARDS[0] + _TOWARDS[1] * _TOWARDS[1])  # [N]


class Views(NamedTuple):
    """The sides that n viewers have around them, T in all."""

    start: Shades  # [2, T] relative to the viewer
    end: Shades  # [2, T]
    viewer: NDArray[np.intp]  # [T] in [0, n)
    side: NDArray[np.intp]  # [T] which of the sides it is


def draw_panoramas(
    views: Views, count: int, sides: Sides, layers: int, horizon: Shades
) -> list[Panorama]:
    """Find what `count` viewers see of `sides` in `layers` L, fading into `horizon` [3, 1].

    Of several as near as each other the last one is seen. A viewer inside of a solid sees its walls
    from behind.
    """
    nearest = _nearest_sides(views, count, sides, layers)
    colours = _colours_of(views, nearest, sides, horizon)
    # Every direction of every layer of every viewer, filled where there is a side.
    size = layers * DIRECTIONS
    top = np.zeros(count * size, np.float32)
    top[nearest.places] = sides.top[views.side[nearest.owner]]
    colour = np.zeros((count, 3, size), np.float32)
    flat = colour.reshape(-1)
    at = nearest.places + nearest.places // size * (2 * size)
    for channel in range(3):
        flat[at + channel * size] = colours[channel]
    shape = (count, layers, DIRECTIONS)
    rows = zip(nearest.reach.reshape(shape), top.reshape(shape), colour, strict=True)
    return [Panorama(*row) for row in rows]


class _Nearest(NamedTuple):
    """Which side is the nearest, in every direction of every layer of every viewer. K = directions
    in which there is one.
    """

    reach: Shades  # [n * L * N] in units of the direction's vector on the square, or NOTHING
    places: NDArray[np.intp]  # [K] where in `reach` there is a side
    owner: NDArray[np.intp]  # [K] which of the T sides of the views it is


def _nearest_sides(views: Views, count: int, sides: Sides, layers: int) -> _Nearest:
    x0, y0 = views.start
    x1, y1 = views.end
    # A viewer exactly on a corner: any direction will do for it.
    x0[(x0 == 0) & (y0 == 0)] = np.float32(1e-6)
    x1[(x1 == 0) & (y1 == 0)] = np.float32(1e-6)

    # The directions that each side spans, counter-clockwise.
    behind = x0 * y1 - y0 * x1 < 0
    ends, _ = directions(np.concatenate([x0, x1]), np.concatenate([y0, y1]))
    of_start, of_end = np.split(ends, 2)
    first = np.where(behind, of_end, of_start)
    last = np.where(behind, of_start, of_end)
    # Half-open intervals of step middles: sides that share a corner leave neither a gap nor an
    # overlap.
    first_step = np.ceil(first - np.float32(0.5)).astype(np.intp)
    steps = (np.ceil(last - np.float32(0.5)).astype(np.intp) - first_step) % DIRECTIONS
    # A side spans less than half a turn; what seems to span more is a side seen edge on.
    steps[steps > DIRECTIONS // 2] = 0

    # One entry for every direction of every side.
    side = np.repeat(np.arange(len(steps)), steps)
    step = np.arange(len(side)) - np.repeat(np.cumsum(steps) - steps - first_step, steps)
    step &= DIRECTIONS - 1

    # How far each of them reaches until it meets its side.
    ex, ey = _edges(views)
    reach = np.take(ey * x0 - ex * y0, side)
    slant = np.take(ey, side)
    slant *= np.take(_TOWARDS[0], step)
    across = np.take(ex, side)
    across *= np.take(_TOWARDS[1], step)
    slant -= across
    with np.errstate(divide="ignore", invalid="ignore"):
        reach /= slant
        reach[~(reach > 0)] = NOTHING

    # The nearest of them.
    place = np.take((views.viewer * layers + sides.layer[views.side]) * DIRECTIONS, side)
    place += step
    nearest = np.full(count * layers * DIRECTIONS, NOTHING, np.float32)
    np.minimum.at(nearest, place, reach)
    wins = np.flatnonzero(reach == np.take(nearest, place))
    owner = np.zeros(len(nearest), np.intp)
    owner[place[wins]] = side[wins]
    places = np.flatnonzero(nearest < NOTHING)
    return _Nearest(nearest, places, owner[places])


def _edges(views: Views) -> tuple[Shades, Shades]:
    """x and y [T] of unit vectors along the sides."""
    ex, ey = views.end - views.start
    length = np.maximum(np.sqrt(ex * ex + ey * ey), np.float32(1e-9))
    return ex / length, ey / length


def _colours_of(views: Views, nearest: _Nearest, sides: Sides, horizon: Shades) -> Shades:
    """The colours [3, K] of the nearest sides."""
    owner = nearest.owner
    side = views.side[owner]
    step = nearest.places & (DIRECTIONS - 1)
    distance = nearest.reach[nearest.places]
    tx = _TOWARDS[0, step]
    ty = _TOWARDS[1, step]
    length = _LENGTH[step]
    ex, ey = _edges(views)
    ex = ex[owner]
    ey = ey[owner]
    x0 = views.start[0, owner]
    y0 = views.start[1, owner]
    facing = np.abs(ey * tx - ex * ty) / length  # 1: straight on

    # Position along the outline in stripes; stripes narrower than a pixel fade into their mean.
    stripe = sides.stripe[side]
    along = sides.offset[side] + (ex * (distance * tx - x0) + ey * (distance * ty - y0)) / stripe
    width = (
        distance
        * length
        * np.float32(2.0 / CAMERA_SIZE)
        / np.maximum(facing, np.float32(0.05))
        / stripe
    )
    wave = np.clip(np.float32(1.6) - np.float32(2.4) * width, np.float32(0.0), np.float32(1.0))
    along *= np.float32(0.5)
    np.negative(wave, out=wave, where=along - np.floor(along) >= np.float32(0.5))

    # Light falls from the viewer; haze takes colour away with distance.
    light = np.float32(0.65) + np.float32(0.35) * facing
    away = distance * length
    left = np.float32(1.0) / (np.float32(1.0) + sides.fading[side] * away * away)
    colours = np.take(sides.amplitude, side, axis=1)
    colours *= wave
    colours += np.take(sides.mean, side, axis=1)
    colours *= light * left
    colours += horizon * (np.float32(1.0) - left)
    return colours
