"""Names beside the marks of a panel, each where it hides least.

A figure whose marks have their names beside them needs no legend, and can be read in grey. For each
name places around its mark are compared, and the cheapest one is used: near, and not on marks,
lines and other names. Names are placed in several rounds, so that an early one can move away from
later ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Boxes = NDArray[np.float64]
"""[B, 4]: left, bottom, right and top in pixels."""

DIRECTIONS = 16  # around a mark, in which a name may stand
DISTANCES = (6.0, 12.0, 20.0, 30.0, 42.0)  # points from the middle of a mark to the name
LINE_FROM = 12.0  # points; a name that stands further off is joined to its mark
ROUNDS = 3
MARK = 5.0  # points from the middle of a mark to its edge
ON_NAME = 6.0
ON_MARK = 4.0
ON_LINE = 1.0
OUTSIDE = 20.0
CROSSING = 40.0
"""The cost of a square point of a name on another name, on a mark, on a line and outside of the
panel; and of each box that the line to its mark crosses. The unit is a point of distance.
"""
# the background of a name, so that a line below it does not make it illegible
PAPER = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.5}


@dataclass(frozen=True)
class Named:
    """A mark with its name, in the units of the panel."""

    x: float
    y: float
    name: str
    bold: bool = False


@dataclass(frozen=True, eq=False)
class _Tried:
    """A name at all of its places: where it is joined to its mark, and its boxes."""

    mark: NDArray[np.float64]  # [2] pixels
    boxes: Boxes  # [P, 4]
    ends: NDArray[np.float64]  # [P, 2] of the line to the mark
    distances: NDArray[np.float64]  # [P] points


def name_marks(
    panel: Axes,
    marks: Sequence[Named],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]] = (),
    size: float = 7.0,
) -> None:
    """Write the names of marks into a panel that is laid out and whose limits are set.

    Args:
        lines: segments from one (x, y) to another that should stay visible.
        size: of the names, in points.
    """
    if not marks:
        return

    # What names should not hide, as boxes in pixels.
    scale = panel.figure.dpi / 72.0
    tried = [_places(panel, mark, size, scale) for mark in marks]
    of_marks = np.array(
        [[*(each.mark - MARK * scale), *(each.mark + MARK * scale)] for each in tried]
    )
    of_lines = _boxes_along(panel, lines, scale)
    window = panel.get_window_extent()
    inside = np.array([[window.x0, window.y0, window.x1, window.y1]])

    # The place of each name, by its index; at first none has one.
    chosen: dict[int, int] = {}
    for _ in range(ROUNDS):
        for i, each in enumerate(tried):
            names = [tried[j].boxes[place] for j, place in chosen.items() if j != i]
            of_names = np.array(names).reshape(-1, 4)
            area = _overlaps(each.boxes, each.boxes, paired=True)
            price = (
                each.distances
                + ON_NAME * _overlaps(each.boxes, of_names) / scale**2
                + ON_MARK * _overlaps(each.boxes, of_marks) / scale**2
                + ON_LINE * _overlaps(each.boxes, of_lines) / scale**2
                + OUTSIDE * (area - _overlaps(each.boxes, inside)) / scale**2
                + CROSSING * _crossed(each, np.vstack([of_names, np.delete(of_marks, i, 0)]))
            )
            # Rounded, since the layout differs in its last bits from process to process, and would
            # decide ties.
            chosen[i] = int(np.argmin(np.round(price, 3)))

    # The names, and a line to those that are far from their marks.
    to_data = panel.transData.inverted()
    for i, (mark, each) in enumerate(zip(marks, tried, strict=True)):
        left, bottom, _, _ = each.boxes[chosen[i]]
        x, y = to_data.transform((left, bottom))
        text = panel.text(
            x,
            y,
            mark.name,
            fontsize=size,
            fontweight="bold" if mark.bold else "normal",
            va="bottom",
            zorder=5,
            bbox=PAPER,
        )
        text.set_in_layout(False)
        if each.distances[chosen[i]] > LINE_FROM:
            ends = to_data.transform([each.mark, each.ends[chosen[i]]])
            panel.plot(*ends.T, color="#777777", linewidth=0.6, zorder=1.5)


def _places(panel: Axes, mark: Named, size: float, scale: float) -> _Tried:
    """All places of a name around its mark."""
    weight = "bold" if mark.bold else "normal"
    text = panel.text(mark.x, mark.y, mark.name, fontsize=size, fontweight=weight)
    canvas: Any = panel.figure.canvas
    extent = text.get_window_extent(canvas.get_renderer())
    text.remove()
    half = np.array([extent.width, extent.height]) / 2
    middle = panel.transData.transform((mark.x, mark.y))
    boxes = []
    ends = []
    distances = []
    for distance in DISTANCES:
        for step in range(DIRECTIONS):
            angle = 2 * math.pi * step / DIRECTIONS
            towards = np.array([math.cos(angle), math.sin(angle)])
            end = middle + distance * scale * towards
            # the name's side that faces the mark is at the end of the line
            centre = end + half * np.clip(1.5 * towards, -1.0, 1.0)
            boxes.append([*(centre - half), *(centre + half)])
            ends.append(end)
            distances.append(distance)
    return _Tried(middle, np.array(boxes), np.array(ends), np.array(distances))


def _boxes_along(
    panel: Axes, lines: Sequence[tuple[tuple[float, float], tuple[float, float]]], scale: float
) -> Boxes:
    """Small boxes that cover segments: [B, 4]."""
    boxes = []
    for line in lines:
        start, end = panel.transData.transform(line)
        parts = max(1, round(float(np.hypot(*(end - start))) / (4.0 * scale)))
        corners = start + np.linspace(0.0, 1.0, parts + 1)[:, None] * (end - start)
        for one, two in pairwise(corners):
            boxes.append([*(np.minimum(one, two) - scale), *(np.maximum(one, two) + scale)])
    return np.array(boxes).reshape(-1, 4)


def _overlaps(boxes: Boxes, others: Boxes, paired: bool = False) -> NDArray[np.float64]:
    """[P] how many square pixels of each of P boxes lie in others, or, paired, in its own other."""
    one = boxes if paired else boxes[:, None]
    width = np.minimum(one[..., 2], others[..., 2]) - np.maximum(one[..., 0], others[..., 0])
    height = np.minimum(one[..., 3], others[..., 3]) - np.maximum(one[..., 1], others[..., 1])
    area: NDArray[np.float64] = np.maximum(width, 0.0) * np.maximum(height, 0.0)
    if paired:
        return area
    total: NDArray[np.float64] = area.sum(1)
    return total


def _crossed(tried: _Tried, boxes: Boxes) -> NDArray[np.float64]:
    """[P] how many boxes the line from the mark to each place of its name crosses."""
    steps = np.linspace(0.2, 0.9, 8)
    # [P, S, 1, 2]
    on_line = (tried.mark + steps[:, None] * (tried.ends - tried.mark)[:, None])[:, :, None]
    # [P, S, B], and for each box whether any step of the line is in it: [P, B]
    within = np.all((on_line >= boxes[:, :2]) & (on_line <= boxes[:, 2:]), axis=-1)
    crossed: NDArray[np.float64] = np.any(within, axis=1).sum(axis=1).astype(np.float64)
    return crossed
