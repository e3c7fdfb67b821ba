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

DIRECTIONS = 512  # N: at least three to the width of a pixel
NOTHING = 1e9  # distance where no side is
_LAYER_RATIO = 2.0


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
    lowest, layers = 0.0, 0
    for height in heights:
        if height > _LAYER_RATIO * lowest:
            lowest, layers = height, layers + 1
        layer_of[height] = layers - 1
    parts: list[Sides] = []
    for wall in walls:
        start = wall.outline.T
        end = np.roll(start, -1, axis=1)
        length = np.sqrt((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2)
        before = np.concatenate([[0.0], np.cumsum(length)[:-1]]) / wall.stripe
        parts.append(
            _sides(
                start, end, wall.top, layer_of[wall.top], wall.colours, wall.stripe, before, haze
            )
        )
    return (join(parts) if parts else _none()), layers


def make_columns(
    places: ArrayLike, shapes: Sequence[tuple[float, float]], colours: Sequence[Colour], layer: int
) -> Columns:
    """Return S columns at `places` [S, 2] with radii and heights `shapes` [S, 2] in m, all in
    one layer.
    """
    count = len(shapes)
    shape = np.array(shapes, np.float32).reshape(count, 2)
    return Columns(
        np.ascontiguousarray(np.asarray(places, np.float32).reshape(count, 2).T),
        shape[:, 0],
        shape[:, 1],
        np.ascontiguousarray(np.array(colours, np.float32).reshape(count, 3).T),
        np.full(count, layer, np.intp),
    )


def column_sides(columns: Columns, ox: Shades, oy: Shades) -> Sides:
    """Turn columns into boards at least a pixel wide, each facing its viewer at ox, oy [S] in m."""
    dx, dy = columns.centre[0] - ox, columns.centre[1] - oy
    distance = np.maximum(np.sqrt(dx * dx + dy * dy), np.float32(1e-6))
    # Five quarters of a pixel at the middle of the image, where a pixel sees the least.
    half = np.maximum(columns.radius, distance * np.float32(1.25 / CAMERA_SIZE)) / distance
    across = np.stack([dy * half, -dx * half])
    start, end, one, none = (
        columns.centre + across,
        columns.centre - across,
        np.ones_like(distance),
        np.zeros_like(distance),
    )
    # Columns are there to be found from far away: they do not fade.
    return Sides(
        start,
        end,
        columns.top,
        columns.layer,
        columns.colour,
        np.zeros_like(columns.colour),
        one,
        none,
        none,
    )


_Parts = TypeVar("_Parts", Sides, Columns)


def join(parts: Sequence[_Parts]) -> _Parts:
    """Concatenate parts along S."""
    first = parts[0]
    return (
        first
        if len(parts) == 1
        else type(first)(*(np.concatenate(fields, axis=-1) for fields in zip(*parts, strict=True)))
    )


def directions(x: Shades, y: Shades) -> tuple[Shades, Shades]:
    """Return where on the square the vectors (x, y) [m] point, in steps: [m] in [0, N], and
    max(|x|, |y|) [m].
    """
    steep = np.abs(y) > np.abs(x)
    along, ahead = np.where(steep, -x, y), np.where(steep, y, x)
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
    at = ((np.arange(DIRECTIONS // 4) + 0.5) / (DIRECTIONS // 8) - 1.0).astype(np.float32)
    one = np.ones_like(at)
    return np.stack([np.concatenate([one, -at, -one, at]), np.concatenate([at, one, -at, -one])])


_TOWARDS = _unit_square()  # [2, N] the middle of each step on the square
_LENGTH = np.sqrt(_TOWARDS[0] * _TOWARDS[0] + _TOWARDS[1] * _TOWARDS[1])


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
    (x0, y0), (x1, y1) = views.start, views.end
    # A viewer exactly on a corner: any direction will do for it.
    x0[(x0 == 0) & (y0 == 0)] = x1[(x1 == 0) & (y1 == 0)] = np.float32(1e-6)
    behind = x0 * y1 - y0 * x1 < 0
    a, b = np.split(directions(np.concatenate([x0, x1]), np.concatenate([y0, y1]))[0], 2)
    first = np.where(behind, b, a)
    last = np.where(behind, a, b)
    # Half-open intervals of step middles: sides that share a corner leave neither a gap nor an
    # overlap.
    first_step = np.ceil(first - np.float32(0.5)).astype(np.intp)
    steps = (np.ceil(last - np.float32(0.5)).astype(np.intp) - first_step) % DIRECTIONS
    # A side spans less than half a turn; what seems to span more is a side seen edge on.
    steps[steps > DIRECTIONS // 2] = 0
    side = np.repeat(np.arange(len(steps)), steps)
    step = np.arange(len(side)) - np.repeat(np.cumsum(steps) - steps - first_step, steps)
    step &= DIRECTIONS - 1

    ex, ey = x1 - x0, y1 - y0
    edge = np.maximum(np.sqrt(ex * ex + ey * ey), np.float32(1e-9))
    ex, ey = ex / edge, ey / edge
    reach = np.take(ey * x0 - ex * y0, side)
    slant = np.take(ey, side)
    slant *= np.take(_TOWARDS[0], step)
    across = np.take(ex, side)
    across *= np.take(_TOWARDS[1], step)
    slant -= across
    with np.errstate(divide="ignore", invalid="ignore"):
        reach /= slant
        reach[~(reach > 0)] = NOTHING
    place = np.take((views.viewer * layers + sides.layer[views.side]) * DIRECTIONS, side)
    place += step
    size = layers * DIRECTIONS
    nearest = np.full(count * size, NOTHING, np.float32)
    np.minimum.at(nearest, place, reach)
    wins = np.flatnonzero(reach == np.take(nearest, place))
    owner = np.zeros(count * size, np.intp)
    owner[place[wins]] = side[wins]

    found = np.flatnonzero(nearest < NOTHING)
    owner, step, distance = owner[found], found & (DIRECTIONS - 1), nearest[found]
    tx, ty, length = _TOWARDS[0, step], _TOWARDS[1, step], _LENGTH[step]
    ex, ey = ex[owner], ey[owner]
    facing = np.abs(ey * tx - ex * ty) / length
    # Position along the outline in stripes; stripes narrower than a pixel fade into their mean.
    x0, y0, owner = x0[owner], y0[owner], views.side[owner]
    stripe = sides.stripe[owner]
    along = sides.offset[owner] + (ex * (distance * tx - x0) + ey * (distance * ty - y0)) / stripe
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
    light = np.float32(0.65) + np.float32(0.35) * facing
    away = distance * length
    left = np.float32(1.0) / (np.float32(1.0) + sides.fading[owner] * away * away)
    colours = np.take(sides.amplitude, owner, axis=1)
    colours *= wave
    colours += np.take(sides.mean, owner, axis=1)
    colours *= light * left
    colours += horizon * (np.float32(1.0) - left)
    top, colour = np.zeros(count * size, np.float32), np.zeros((count, 3, size), np.float32)
    top[found] = sides.top[owner]
    flat, at = colour.reshape(-1), found + found // size * (2 * size)
    for channel in range(3):
        flat[at + channel * size] = colours[channel]
    shape = (count, layers, DIRECTIONS)
    return [
        Panorama(*each)
        for each in zip(nearest.reshape(shape), top.reshape(shape), colour, strict=True)
    ]


def _sides(
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    top: float,
    layer: int,
    colours: tuple[Colour, Colour],
    stripe: float,
    before: NDArray[np.float64],
    haze: float,
) -> Sides:
    count = start.shape[1]
    one = np.ones(count, np.float32)
    first, second = (np.array(colour, np.float32)[:, None] * one for colour in colours)
    half = np.float32(0.5)
    return Sides(
        start.astype(np.float32),
        end.astype(np.float32),
        one * np.float32(top),
        np.full(count, layer, np.intp),
        (first + second) * half,
        (first - second) * half,
        one * np.float32(stripe),
        before.astype(np.float32),
        one * np.float32(1.0 / haze**2),
    )


def _none() -> Sides:
    return _sides(
        np.zeros((2, 0)),
        np.zeros((2, 0)),
        0.0,
        0,
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        1.0,
        np.zeros(0),
        1.0,
    )
