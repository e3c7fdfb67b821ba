"""How all figures of a report look: colours and markers of methods, lines, grids and legends."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Literal
from zlib import crc32

import numpy as np

from wasp_cli.cells.table import Floats
from wasp_cli.methods.registry import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


PALETTE = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#CC79A7", "#0072B2")
"""Okabe and Ito: distinguishable with every common colour blindness. `wasp` is vermilion."""

METHOD_MARKERS = ("o", "s", "^", "v", "D", "P", "X")
# line styles of methods with the same colour; the last one is for classes of one's own
LINES = ("-", "--", ":")
# Colour and marker of a method, the same in every figure; markers tell methods apart in print. With
# every round of the colours markers move on by one, since otherwise the eighth method would look
# like the first.
STYLES = {
    name: (PALETTE[i % len(PALETTE)], METHOD_MARKERS[(i + i // len(PALETTE)) % len(METHOD_MARKERS)])
    for i, name in enumerate(METHODS)
}


def style_of(method: str) -> tuple[str, str]:
    """Return colour and marker of a method. For a class of one's own they are computed from its
    name, among those that no method of this package has.
    """
    if method in STYLES:
        return STYLES[method]
    free = [style for style in product(PALETTE[1:], METHOD_MARKERS) if style not in STYLES.values()]
    return free[crc32(method.encode()) % len(free)]


def ruled(panel: Axes, axis: Literal["both", "x", "y"] = "both") -> None:
    """Draw a grid behind everything else."""
    panel.grid(axis=axis, color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)


def legend(figure: Figure, panels: Iterable[Axes], most: int = 0, **options: Any) -> None:
    """Draw one legend for some panels, with each label once.

    Args:
        most: entries in a row at most, spread evenly over as many rows as the width needs; 0: one
            below the other.
        options: of matplotlib's legend.
    """
    handles = {
        label: handle
        for panel in panels
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    rows = math.ceil(len(handles) / most) if most else len(handles)
    while handles:
        shown = figure.legend(
            handles.values(),
            handles.keys(),
            frameon=False,
            ncols=math.ceil(len(handles) / rows),
            **options,
        )
        if rows >= len(handles) or shown.get_window_extent().width <= MARGIN * figure.bbox.width:
            break
        shown.remove()
        rows += 1


GREY = "#999999"
MARGIN = 0.97  # of a figure's width that a legend may take


@dataclass(frozen=True, eq=False)
class Line:
    """A line of n points, and how it looks."""

    x: Floats  # [n]
    y: Floats  # [n]; NaN is left out
    label: str = ""
    colour: str = PALETTE[6]
    style: str = "-"  # `none`: marks alone
    marker: str = ""
    width: float = 1.2
    alpha: float = 1.0  # of the line
    size: float = 3.0  # of the marks
    areas: Floats | None = None  # [n] of marks that differ in size
    gaps: bool = False  # whether NaN interrupts the line instead


def draw_lines(
    panel: Axes, lines: Iterable[Line], *, diagonal: tuple[float, float] | None = None, **axes: Any
) -> None:
    """Draw lines over a grid, and a grey line of equal x and y from one to the other end of
    `diagonal`; a shared label is named once.
    """
    if diagonal is not None:
        panel.plot(diagonal, diagonal, color=GREY, linewidth=0.8, zorder=0.9)
    named: set[str] = set()
    for line in lines:
        here = np.isfinite(line.x) & np.isfinite(line.y)
        if line.gaps:
            here[:] = True
        label = line.label if line.label and line.label not in named else None
        named.add(line.label)
        plain = line.areas is None
        panel.plot(
            line.x[here],
            line.y[here],
            color=line.colour,
            alpha=line.alpha,
            linestyle=line.style,
            linewidth=line.width,
            marker=line.marker if plain else "",
            markersize=line.size,
            label=label if plain else None,
        )
        if line.areas is not None:
            panel.scatter(
                line.x[here],
                line.y[here],
                line.areas[here],
                color=line.colour,
                marker=line.marker or "o",
                linewidths=0,
                label=label,
            )
    ruled(panel)
    panel.set(**axes)
