"""Outlines on a grid: which cells they hold, and how far cells are from them. Cells have their
middles at `x` [W] and `y` [H].
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from wasp_cli.tasks.base import Bools, Floats


def filled(ring: Floats, x: Floats, y: Floats) -> Bools:
    """Tell whether each cell's middle is inside a closed ring [V, 2] -> bool [H, W], by the
    parity of crossings; `x` ascends.
    """
    x0, y0 = ring.T
    x1 = np.roll(x0, -1)
    y1 = np.roll(y0, -1)
    odd = np.zeros((len(y), len(x)), np.bool_)
    for row, height in enumerate(y.tolist()):
        cuts = np.flatnonzero((y0 > height) != (y1 > height))
        if len(cuts):
            # Where the row's middle line crosses the ring.
            at = x0[cuts] + (height - y0[cuts]) * (x1[cuts] - x0[cuts]) / (y1[cuts] - y0[cuts])
            odd[row] = np.searchsorted(np.sort(at), x) % 2 == 1
    return odd


def around(x: Floats, y: Floats, low: Floats, high: Floats) -> tuple[slice, slice]:
    """Return rows and columns of the cells in the rectangle from `low` [2] to `high` [2]; `x`
    ascends, `y` ascends or descends.
    """
    columns = slice(int(np.searchsorted(x, low[0])), int(np.searchsorted(x, high[0])))
    if len(y) > 1 and y[0] > y[-1]:
        rows = slice(int(np.searchsorted(-y, -high[1])), int(np.searchsorted(-y, -low[1])))
    else:
        rows = slice(int(np.searchsorted(y, low[1])), int(np.searchsorted(y, high[1])))
    return rows, columns


class NearSide(NamedTuple):
    """A side of an outline, and the cells around it."""

    number: int  # of the side, from 0
    window: tuple[slice, slice]  # rows and columns of the cells: h and w of them
    distance: Floats  # [h, w] from the side
    share: Floats  # [h, w] of the side's length before the point that is nearest to the cell


def near_sides(sides: Floats, x: Floats, y: Floats, reach: float) -> Iterator[NearSide]:
    """Yield the sides [V, 2, 2] that have cells around them, in order.

    A window holds at least the cells within `reach` of its side.
    """
    for number, (start, end) in enumerate(sides):
        window = around(x, y, np.minimum(start, end) - reach, np.maximum(start, end) + reach)
        rows, columns = window
        dx = x[columns] - start[0]
        dy = (y[rows] - start[1])[:, None]
        if dx.size and dy.size:
            ex, ey = end - start
            share = np.clip((dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-18), 0.0, 1.0)
            distance = np.sqrt((dx - share * ex) ** 2 + (dy - share * ey) ** 2)
            yield NearSide(number, window, distance, share)
