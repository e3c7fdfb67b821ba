"""Barrels that were placed within a barrier: the placement knows nothing of barriers."""

from __future__ import annotations

import numpy as np

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.formula.model import BARREL_RADIUS
from wasp_cli.tasks.outline import distance_to_segments, inside, segments

_CLEARANCE = BARREL_RADIUS + 0.002
_ROUNDS = 4

_OUTER_MIDDLE = 0.15
"""How far behind its face in m the middle of the outer barrier lies: what is laid out farther out leaves it outward."""
_RINGS = ((track.OUTER_BARRIER, _OUTER_MIDDLE), (track.INNER_BARRIER, 0.0), (track.PIT_WALL, 0.0))


def freed(places: Floats) -> Floats:
    """Barrels [F, 2], those that overlap a barrier moved away from its nearest side until they touch it no more.

    Those that lie outside of the outer barrier stay there, out of everybody's way.
    Where two sides meet, moving away from one can lead into the other: what still overlaps after some rounds stays as it is.
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
    """Move barrels in place; `behind` tells how far behind its ring those lie that it sends inward (0: the ring is a solid)."""
    sides = segments(ring)
    apart = distance_to_segments(places, sides)
    nearest = apart.argmin(axis=1)
    gap = apart[np.arange(len(places)), nearest]
    within = inside(places, ring)
    stuck = np.where(within, gap < _CLEARANCE, gap < behind) if behind else (gap < _CLEARANCE) | (within & (gap < 2.0 * _CLEARANCE))
    if not stuck.any():
        return False
    start, end = sides[nearest[stuck], 0], sides[nearest[stuck], 1]
    along = end - start
    share = ((places[stuck] - start) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-18)
    foot = start + np.clip(share, 0.0, 1.0)[:, None] * along
    # Away from the ring's line, toward the free side: outward of a solid, inward of the outer barrier's ring.
    away = places[stuck] - foot
    wrong_side = within[stuck] if not behind else ~within[stuck]
    away[wrong_side] *= -1.0
    length = np.sqrt((away**2).sum(axis=1, keepdims=True))
    places[stuck] = foot + away / np.maximum(length, 1e-9) * _CLEARANCE * 1.001
    return True
