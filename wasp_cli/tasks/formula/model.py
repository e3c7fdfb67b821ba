"""The bodies of Formula One as MuJoCo models: the car, some of the 200 barrels, and the
barriers as a fence of thin boxes.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.car import car_mjcf
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.outline import distance_to_segments, inside, segments
from wasp_cli.tasks.physics import STATIC_SENSOR, body_sensor

BARREL_RADIUS, BARREL_RIM, BARREL_TOP_RADIUS, BARREL_HEIGHT = 0.162, 0.05, 0.09, 0.375
"""A barrel is as wide as its foot up to the rim's height, and narrows to its top; in m."""
BARREL_MASS = 1.40e-5  # kg
_BARREL_CORNERS = 16

OUTER_THICKNESS, INNER_THICKNESS = 0.2, 0.06
"""Of the boxes behind the barriers' faces, in m; the inner barrier itself is about 0.3 m thick."""


SECTOR = 4.0
"""Side of the squares into which the map is cut, in m: near a barrier only the boxes around its
square are in the model.
"""
# how far the boxes reach beyond the square, in m: as far as a moving barrel is followed, and half a
# metre
SECTOR_MARGIN = 3.5
_COLUMNS = 32


def sectors(xy: Floats) -> NDArray[np.int64]:
    """Return the number [n], from 2, of the square that holds each place [n, 2] of the map, in
    m.
    """
    cell = np.clip(np.floor((xy - _ORIGIN) / SECTOR), 0, _COLUMNS - 1).astype(np.int64)
    numbers: NDArray[np.int64] = 2 + cell[:, 0] + _COLUMNS * cell[:, 1]
    return numbers


_ORIGIN = np.array([-32.0, -64.0])


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
    return " ".join(
        f"{r * math.cos(a):.6f} {r * math.sin(a):.6f} {z}"
        for r, z in rings
        for a in around.tolist()
    )


def _barriers(walls: int) -> str:
    """Boxes along the sides of everything that can be touched, so far as they lie around a
    square.
    """
    pit = (track.PIT_WALL, INNER_THICKNESS, track.PIT_WALL_BOTTOM, track.PIT_WALL_TOP)
    # The boxes lie behind the faces: outside of the outer ring, within the solid of the inner one.
    outer = (track.OUTER_BARRIER, -OUTER_THICKNESS, track.WALL_BOTTOM, track.WALL_TOP)
    inner = (track.INNER_BARRIER, INNER_THICKNESS, track.WALL_BOTTOM, track.WALL_TOP)
    return (
        "".join(box for fence in (outer, inner, pit) for box in _fence(*fence, walls)) or _NOWHERE
    )


# A square without barriers still has the body
_NOWHERE = '<geom type="sphere" size="0.01" pos="0 0 -10"/>'


def _around(sides: Floats, walls: int) -> NDArray[np.intp]:
    """Indices of the sides [V, 2, 2] in and around a square."""
    if walls == 1:
        return np.arange(len(sides))
    cell = np.array([(walls - 2) % _COLUMNS, (walls - 2) // _COLUMNS])
    low = _ORIGIN + SECTOR * cell - SECTOR_MARGIN
    high = low + SECTOR + 2.0 * SECTOR_MARGIN
    return np.flatnonzero(((sides.max(axis=1) >= low) & (sides.min(axis=1) <= high)).all(axis=1))


def _fence(ring: Floats, thickness: float, bottom: float, top: float, walls: int) -> list[str]:
    """Boxes along a closed ring, on its inner side (thickness > 0) or its outer side (< 0)."""
    x, y = ring[:, 0], ring[:, 1]
    area = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    side = math.copysign(1.0, area) * thickness / 2.0
    sides = segments(ring)
    boxes = []
    for (x0, y0), (x1, y1) in sides[_around(sides, walls)].tolist():
        length = math.hypot(x1 - x0, y1 - y0)
        along = ((x1 - x0) / length, (y1 - y0) / length)
        centre = (
            (x0 + x1) / 2.0 - along[1] * side,
            (y0 + y1) / 2.0 + along[0] * side,
            (bottom + top) / 2.0,
        )
        size = f"{length / 2.0:.6f} {abs(thickness) / 2.0} {(top - bottom) / 2.0}"
        turn = math.atan2(along[1], along[0])
        boxes.append(
            f'<geom type="box" pos="{centre[0]:.6f} {centre[1]:.6f} {centre[2]}" '
            f'size="{size}" euler="0 0 {turn:.8f}"/>'
        )
    return boxes


_CLEARANCE = BARREL_RADIUS + 0.002
_ROUNDS = 4

_OUTER_MIDDLE = 0.15
"""How far behind its face in m the middle of the outer barrier lies: what is laid out farther
out leaves it outward.
"""
_RINGS = ((track.OUTER_BARRIER, _OUTER_MIDDLE), (track.INNER_BARRIER, 0.0), (track.PIT_WALL, 0.0))


def clear_of_barriers(places: Floats) -> Floats:
    """Move those of the barrels [F, 2] (in m) that overlap a barrier away from its nearest side
    until they touch it no more -> [F, 2].

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
    """Move barrels in place; `behind` tells how far behind its ring those lie that it sends
    inward (0: the ring is a solid).
    """
    sides = segments(ring)
    apart = distance_to_segments(places, sides)
    nearest = apart.argmin(axis=1)
    gap = apart[np.arange(len(places)), nearest]
    within = inside(places, ring)
    stuck = (
        np.where(within, gap < _CLEARANCE, gap < behind)
        if behind
        else (gap < _CLEARANCE) | (within & (gap < 2.0 * _CLEARANCE))
    )
    if not stuck.any():
        return False
    start, end = sides[nearest[stuck], 0], sides[nearest[stuck], 1]
    along = end - start
    share = ((places[stuck] - start) * along).sum(axis=1) / np.maximum(
        (along**2).sum(axis=1), 1e-18
    )
    foot = start + np.clip(share, 0.0, 1.0)[:, None] * along
    # Away from the ring's line, toward the free side: outward of a solid, inward of the outer
    # barrier's ring.
    away = places[stuck] - foot
    wrong_side = within[stuck] if not behind else ~within[stuck]
    away[wrong_side] *= -1.0
    length = np.sqrt((away**2).sum(axis=1, keepdims=True))
    places[stuck] = foot + away / np.maximum(length, 1e-9) * _CLEARANCE * 1.001
    return True
