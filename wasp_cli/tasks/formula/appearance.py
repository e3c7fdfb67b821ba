"""What Formula One looks like: along the lap the outer barrier (red and white) is on the left,
the inner one (blue and white) on the right.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.camera.appearance import (
    Appearance,
    Colour,
    Kind,
    Landmark,
    Painter,
    Shades,
    Wall,
)
from wasp_cli.tasks.camera.raster import filled, near_sides
from wasp_cli.tasks.car import CAMERA_HEIGHT, CAR_PARTS, FORWARD
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.outline import segments

CELL = 0.1  # side of the finest cells in m
_COARSER = 4  # cells of one level along a cell of the next
_LEVELS = 3
_WEST = -14.4  # corner of the texture, in m
_SOUTH = -38.4
_COLUMNS = 528  # finest cells
_ROWS = 544

CHEVRON_PERIOD = 2.4  # length of a chevron along the lap in m
CHEVRON_SWEEP = 0.6  # how far its tip is ahead of its wings, per m to the side
_ROAD_DARK = (0.12, 0.12, 0.17)
_ROAD_LIGHT = (0.74, 0.72, 0.64)
_GRASS = (0.20, 0.42, 0.14)
_INFIELD = (0.46, 0.50, 0.20)
_RUN_OFF = (0.86, 0.60, 0.28)
_RUN_OFF_WIDTH = 0.3  # beside the barriers, in m
_ROAD_MARGIN = 0.4  # of the road beyond the lap's half width, in m
_SEARCH = 5.0  # distance from the centre line within which cells are part of the road, in m


class Ground:
    """The ground as a texture: cells of three sizes, of which a pixel reads the one that is about
    as large as it.
    """

    def painter(self, footprint: Shades) -> Painter:
        """Return what paints [m] places, smoothed over `footprint` [m] in m."""
        texture = _texture()
        level = (footprint > np.float32(2.0 * CELL)).astype(np.intp)
        level += footprint > np.float32(2.0 * CELL * _COARSER)
        per_metre = texture.per_metre[level]
        columns = texture.columns[level]
        rows = texture.rows[level]
        start = texture.start[level]

        def paint(x: Shades, y: Shades) -> Shades:
            column = ((x - np.float32(_WEST)) * per_metre).astype(np.intp)
            row = ((y - np.float32(_SOUTH)) * per_metre).astype(np.intp)
            np.clip(column, 0, columns - 1, out=column)
            np.clip(row, 0, rows - 1, out=row)
            row *= columns
            row += column
            row += start
            colours: Shades = np.take(texture.colours, row, axis=1)
            return colours

        return paint


class _Texture(NamedTuple):
    """All levels behind each other."""

    colours: Shades  # [3, all cells]
    start: NDArray[np.intp]  # [levels] first cell
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    per_metre: Shades  # [levels] cells per m


@lru_cache
def _texture() -> _Texture:
    # Every level has the means of the cells of the one before.
    levels = [_finest()]
    for _ in range(_LEVELS - 1):
        levels.append(_coarser(levels[-1]))
    # Rounded to 1/4096, so that the last bits of building it are gone.
    rounded = [np.floor(level * 4096.0 + 0.5) / 4096.0 for level in levels]
    flat = [level.astype(np.float32).reshape(3, -1) for level in rounded]
    sizes = np.array([level[0].size for level in levels])
    return _Texture(
        colours=np.concatenate(flat, axis=1),
        start=np.cumsum(sizes) - sizes,
        rows=np.array([level.shape[1] for level in levels]),
        columns=np.array([level.shape[2] for level in levels]),
        per_metre=np.array(
            [1.0 / (CELL * _COARSER**index) for index in range(_LEVELS)], np.float32
        ),
    )


def _coarser(colours: Floats) -> Floats:
    """The means of squares of cells [3, rows, columns], summed in a fixed order."""
    total = np.zeros_like(colours[:, ::_COARSER, ::_COARSER])
    for i in range(_COARSER):
        for j in range(_COARSER):
            total = total + colours[:, i::_COARSER, j::_COARSER]
    return total / float(_COARSER * _COARSER)


def _finest() -> Floats:
    """The colours [3, rows, columns] of the finest cells."""
    x = _WEST + (np.arange(_COLUMNS, dtype=np.float64) + 0.5) * CELL
    y = _SOUTH + (np.arange(_ROWS, dtype=np.float64) + 0.5) * CELL
    shape = (_ROWS, _COLUMNS)

    # Of each cell: its distance from the centre line, how far along the lap that is, and the half
    # width of the road there.
    apart = np.full(shape, np.inf)
    arc = np.zeros(shape)
    half_width = np.zeros(shape)
    middle = segments(track.LAP[:, :2])
    lengths = np.sqrt(((middle[:, 1] - middle[:, 0]) ** 2).sum(axis=1))
    before = np.cumsum(lengths) - lengths
    widths = track.LAP[:, 2]
    for side in near_sides(middle, x, y, _SEARCH):
        number = side.number
        window = side.window
        nearer = side.distance < apart[window]
        apart[window][nearer] = side.distance[nearer]
        side_arc = before[number] + side.share * lengths[number]
        arc[window][nearer] = side_arc[nearer]
        widening = widths[(number + 1) % len(widths)] - widths[number]
        side_width = widths[number] + side.share * widening
        half_width[window][nearer] = side_width[nearer]

    # Grass, and the infield between the barriers.
    colours = np.empty((3, *shape))
    colours[:] = _colour(_GRASS)
    within = filled(track.OUTER_BARRIER, x, y) & ~filled(track.INNER_BARRIER, x, y)
    colours[:, within] = _colour(_INFIELD)[:, 0]

    # The road. A whole number of chevrons, so that the lap has no seam.
    period = lengths.sum() / round(float(lengths.sum()) / CHEVRON_PERIOD)
    phase = (arc + CHEVRON_SWEEP * np.where(np.isfinite(apart), apart, 0.0)) / period
    phase -= np.floor(phase)
    road = within & (apart < half_width + _ROAD_MARGIN)
    dark = _colour(_ROAD_DARK)[:, 0]
    light = _colour(_ROAD_LIGHT)[:, 0]
    colours[:, road] = dark + (light - dark) * phase[road]

    # What runs along the barriers.
    run_off = _colour(_RUN_OFF)[:, 0]
    for ring in (track.OUTER_BARRIER, track.INNER_BARRIER, track.PIT_WALL):
        for side in near_sides(segments(ring), x, y, _RUN_OFF_WIDTH):
            cells = colours[(slice(None), *side.window)]
            cells[:, side.distance < _RUN_OFF_WIDTH] = run_off
    return colours


def _colour(rgb: Colour) -> Floats:
    """A colour as [3, 1, 1]."""
    return np.array(rgb)[:, None, None]


_WALL_TOP = 0.6
"""Lower than what the car collides with (invisible in the reference package), so that beacon
and towers are seen over it.
"""
_BEACON_RADIUS = 0.3  # in m
_BEACON_TOP = 3.0  # height in m
_BARREL_REACH = 15.0  # distance in m beyond which a barrel is smaller than a pixel

_WHITE = (0.92, 0.92, 0.92)
_LANDMARKS = (
    Landmark((6.0, 21.0), 0.8, 6.0, (0.85, 0.10, 0.10)),
    Landmark((19.0, 9.0), 0.8, 6.0, (1.00, 0.55, 0.00)),
    Landmark((33.0, 6.0), 0.8, 6.0, (0.98, 0.90, 0.10)),
    Landmark((43.0, -6.0), 0.8, 6.0, (0.45, 0.85, 0.10)),
    Landmark((33.0, -16.0), 0.8, 6.0, (0.05, 0.40, 0.15)),
    Landmark((22.0, -4.8), 0.6, 4.0, (0.10, 0.75, 0.75)),
    Landmark((22.0, -32.0), 0.8, 6.0, (0.10, 0.25, 0.90)),
    Landmark((3.0, -42.0), 0.8, 6.0, (0.50, 0.10, 0.75)),
    Landmark((-19.0, -38.0), 0.8, 6.0, (0.30, 0.15, 0.05)),
    Landmark((-14.0, -18.0), 0.8, 6.0, (0.95, 0.95, 0.95)),
    Landmark((-7.0, 4.0), 0.8, 6.0, (0.05, 0.05, 0.08)),
    Landmark((10.0, -14.2), 0.4, 4.0, (0.95, 0.60, 0.60)),
)


@lru_cache
def appearance(level: int) -> Appearance:
    """Return the appearance of level 0 (no barrels) or 1."""
    beacon = (
        f'<geom type="cylinder" pos="0 0 {_BEACON_TOP / 2}" size="{_BEACON_RADIUS} '
        f'{_BEACON_TOP / 2}"/>'
    )
    goal = Kind("goal", beacon, (1.0, 0.0, 1.0), column=(_BEACON_RADIUS, _BEACON_TOP))
    # A barrel narrows to its top: four cylinders (radius, bottom, top) stand for it.
    barrel = ""
    for radius, low, high in (
        (0.162, 0.0, 0.05),
        (0.146, 0.05, 0.14),
        (0.124, 0.14, 0.25),
        (0.1, 0.25, 0.375),
    ):
        middle = (low + high) / 2
        half_height = (high - low) / 2
        barrel += (
            f'<geom type="cylinder" pos="0 0 {middle:.4f}" size="{radius} {half_height:.4f}"/>'
        )
    vase = Kind("vase", barrel, (1.00, 0.40, 0.00), reach=_BARREL_REACH)
    return Appearance(
        robot=CAR_PARTS,
        camera_height=CAMERA_HEIGHT,
        forward=FORWARD,
        floor=Ground(),
        walls=(
            Wall(track.OUTER_BARRIER, _WALL_TOP, ((0.72, 0.05, 0.08), _WHITE), 1.0, hollow=True),
            Wall(track.INNER_BARRIER, _WALL_TOP, ((0.10, 0.20, 0.80), _WHITE), 1.0),
            Wall(track.PIT_WALL, _WALL_TOP, ((0.95, 0.80, 0.05), (0.15, 0.15, 0.15)), 1.0),
        ),
        landmarks=_LANDMARKS,
        kinds=(goal,) if level == 0 else (goal, vase),
        map_half_side=26.5,
        map_centre=(11.4, -10.8),
        # A bright sky, in which dark and bright towers are seen alike; haze of a clear day.
        horizon=(0.66, 0.75, 0.85),
        zenith=(0.38, 0.54, 0.80),
        haze=40.0,
    )
