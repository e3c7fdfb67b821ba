"""The bodies of Formula One as MuJoCo models: the car, some of the 200 barrels, and the
barriers as a fence of thin boxes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.car import car_mjcf
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.outline import distance_to_segments, inside, segments
from wasp_cli.tasks.physics import STATIC_SENSOR, body_sensor

# A barrel is as wide as its foot up to the rim's height, and narrows to its top; in m.
BARREL_RADIUS = 0.162
BARREL_RIM = 0.05
BARREL_TOP_RADIUS = 0.09
BARREL_HEIGHT = 0.375
BARREL_MASS = 1.40e-5  # kg
_BARREL_CORNERS = 16

# of the boxes behind the barriers' faces, in m; the inner barrier itself is about 0.3 m thick
OUTER_THICKNESS = 0.2
INNER_THICKNESS = 0.06

SECTOR = 4.0
"""Side of the squares into which the map is cut, in m: near a barrier only the boxes around its
square are in the model.
"""
# how far the boxes reach beyond the square, in m: as far as a moving barrel is followed, and half a
# metre
SECTOR_MARGIN = 3.5
_COLUMNS = 32
_ORIGIN = np.array([-32.0, -64.0])  # corner of the square 2, in m


def sectors(xy: Floats) -> NDArray[np.int64]:
    """Return the number [n], from 2, of the square that holds each place [n, 2] of the map, in
    m.
    """
    cell = np.clip(np.floor((xy - _ORIGIN) / SECTOR), 0, _COLUMNS - 1).astype(np.int64)
    numbers: NDArray[np.int64] = 2 + cell[:, 0] + _COLUMNS * cell[:, 1]
    return numbers


def build_model(bodies: int, walls: int, integrate: bool) -> mujoco.MjModel:
    """Build the car, some barrels, and no barriers (`walls` 0), all of them (1), or those in and
    around a square (its number).

    Barrels of 14 mg are unstable under Euler with this timestep, hence RK4. Sensors and contacts
    are those of a single forward pass, for which any integrator does.
    """
    assets = f'<mesh name="barrel" vertex="{barrel_corners()}"/>' if bodies else ""
    others = "".join(
        f'<body name="vase{i}" pos="{i + 2} 0 0"><freejoint/><geom type="mesh" '
        f'mesh="barrel" mass="{BARREL_MASS}"/></body>'
        for i in range(bodies)
    )
    touches = "".join(
        f'<contact name="{body_sensor(i)}" subtree1="agent" body2="vase{i}" data="found"/>'
        for i in range(bodies)
    )
    if walls:
        others += f'<body name="barriers">{_barriers(walls)}</body>'
        touches += (
            f'<contact name="{STATIC_SENSOR}" subtree1="agent" body2="barriers" data="found"/>'
        )
    return mujoco.MjModel.from_xml_string(
        car_mjcf(
            "RK4" if integrate else "Euler",
            others=others,
            assets=assets,
            sensors=None if integrate else touches,
        )
    )


def barrel_corners() -> str:
    """Return the vertices of a barrel's convex hull as MJCF wants them, in m; the foot stands
    on z = 0.
    """
    around = np.arange(_BARREL_CORNERS) * (2.0 * math.pi / _BARREL_CORNERS)
    rings = ((BARREL_RADIUS, 0.0), (BARREL_RADIUS, BARREL_RIM), (BARREL_TOP_RADIUS, BARREL_HEIGHT))
    corners = []
    for r, z in rings:
        for angle in around.tolist():
            corners.append(f"{r * math.cos(angle):.6f} {r * math.sin(angle):.6f} {z}")
    return " ".join(corners)


class _Fence(NamedTuple):
    """A barrier: boxes along a closed ring."""

    ring: Floats  # [V, 2]
    thickness: float  # on the inner side of the ring, or on its outer side (negative); in m
    bottom: float
    top: float


def _barriers(walls: int) -> str:
    """MJCF of the boxes of all barriers, so far as they lie in and around a square."""
    # The boxes lie behind the faces: outside of the outer ring, within the solid of the inner one.
    outer = _Fence(track.OUTER_BARRIER, -OUTER_THICKNESS, track.WALL_BOTTOM, track.WALL_TOP)
    inner = _Fence(track.INNER_BARRIER, INNER_THICKNESS, track.WALL_BOTTOM, track.WALL_TOP)
    pit = _Fence(track.PIT_WALL, INNER_THICKNESS, track.PIT_WALL_BOTTOM, track.PIT_WALL_TOP)
    boxes: list[str] = []
    for fence in (outer, inner, pit):
        boxes += _boxes(fence, walls)
    return "".join(boxes) or _NOWHERE


# a square without barriers still has the body
_NOWHERE = '<geom type="sphere" size="0.01" pos="0 0 -10"/>'


def _around(sides: Floats, walls: int) -> NDArray[np.intp]:
    """Indices of the sides [V, 2, 2] in and around a square."""
    if walls == 1:
        return np.arange(len(sides))
    cell = np.array([(walls - 2) % _COLUMNS, (walls - 2) // _COLUMNS])
    low = _ORIGIN + SECTOR * cell - SECTOR_MARGIN
    high = low + SECTOR + 2.0 * SECTOR_MARGIN
    return np.flatnonzero(((sides.max(axis=1) >= low) & (sides.min(axis=1) <= high)).all(axis=1))


def _boxes(fence: _Fence, walls: int) -> list[str]:
    """MJCF of the boxes of one barrier."""
    # How far left of each side the middle of its box lies: the sign of twice the area tells in
    # which sense the ring runs.
    x = fence.ring[:, 0]
    y = fence.ring[:, 1]
    area = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    side = math.copysign(1.0, area) * fence.thickness / 2.0
    sides = segments(fence.ring)
    boxes = []
    for (x0, y0), (x1, y1) in sides[_around(sides, walls)].tolist():
        length = math.hypot(x1 - x0, y1 - y0)
        along = ((x1 - x0) / length, (y1 - y0) / length)
        centre = (
            (x0 + x1) / 2.0 - along[1] * side,
            (y0 + y1) / 2.0 + along[0] * side,
            (fence.bottom + fence.top) / 2.0,
        )
        half_height = (fence.top - fence.bottom) / 2.0
        size = f"{length / 2.0:.6f} {abs(fence.thickness) / 2.0} {half_height}"
        turn = math.atan2(along[1], along[0])
        boxes.append(
            f'<geom type="box" pos="{centre[0]:.6f} {centre[1]:.6f} {centre[2]}" '
            f'size="{size}" euler="0 0 {turn:.8f}"/>'
        )
    return boxes


_CLEARANCE = BARREL_RADIUS + 0.002  # of a barrel's middle from a barrier, in m
_ROUNDS = 4

_OUTER_MIDDLE = 0.15
"""How far behind its face in m the middle of the outer barrier lies: what is laid out farther
out leaves it outward.
"""
_RINGS = ((track.OUTER_BARRIER, _OUTER_MIDDLE), (track.INNER_BARRIER, 0.0), (track.PIT_WALL, 0.0))


def clear_of_barriers(places: Floats) -> Floats:
    """Return the places of barrels [F, 2] in m; those that overlap a barrier are moved away from
    its nearest side, until they do not touch it any more.

    Those that lie outside of the outer barrier stay there, out of everybody's way.
    Where two sides meet, moving away from one can lead into the other: what still overlaps after
    some rounds stays as it is.
    """
    places = places.copy()
    for _ in range(_ROUNDS):
        moved = False
        for ring, outside in _RINGS:
            moved |= _free_of(places, ring, -outside)
        if not moved:
            break
    return places


def _free_of(places: Floats, ring: Floats, behind: float) -> bool:
    """Move the barrels that overlap a ring, in place; return whether there were any.

    `behind`: how far behind its ring those lie that it sends inward, as a negative number; 0 where
    the ring is a solid.
    """
    # The nearest side of each barrel.
    sides = segments(ring)
    apart = distance_to_segments(places, sides)
    nearest = apart.argmin(axis=1)
    gap = apart[np.arange(len(places)), nearest]
    within = inside(places, ring)
    if behind:
        stuck = np.where(within, gap < _CLEARANCE, gap < behind)
    else:
        stuck = (gap < _CLEARANCE) | (within & (gap < 2.0 * _CLEARANCE))
    if not stuck.any():
        return False
    # The point of that side that is nearest to it.
    start = sides[nearest[stuck], 0]
    end = sides[nearest[stuck], 1]
    along = end - start
    length2 = np.maximum((along**2).sum(axis=1), 1e-18)
    share = ((places[stuck] - start) * along).sum(axis=1) / length2
    foot = start + np.clip(share, 0.0, 1.0)[:, None] * along
    # Away from the ring's line, toward the free side: outward of a solid, inward of the outer
    # barrier's ring.
    away = places[stuck] - foot
    wrong_side = within[stuck] if not behind else ~within[stuck]
    away[wrong_side] *= -1.0
    length = np.sqrt((away**2).sum(axis=1, keepdims=True))
    places[stuck] = foot + away / np.maximum(length, 1e-9) * _CLEARANCE * 1.001
    return True
