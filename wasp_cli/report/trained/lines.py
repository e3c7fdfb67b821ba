"""Draw lines into a panel: the one builder of learning curves, horizons and reliability diagrams."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from wasp_cli.report.figures.style import PALETTE
from wasp_cli.report.trained.read import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GREY = "#999999"


@dataclass(frozen=True, eq=False)
class Line:
    """One line of a panel."""

    x: Floats
    """[n]"""
    y: Floats
    """[n]; NaN is left out"""
    label: str = ""
    colour: str = PALETTE[6]
    style: str = "-"
    """`none`: marks alone"""
    marker: str = ""
    width: float = 1.2
    alpha: float = 1.0
    """of the line"""
    size: float = 3.0
    """of the marks"""
    areas: Floats | None = None
    """[n] of marks that differ in size"""
    gaps: bool = False
    """Whether NaN interrupts the line instead."""


def draw_lines(panel: Axes, lines: Iterable[Line], *, diagonal: tuple[float, float] | None = None, **axes: Any) -> None:
    """Draw lines over a grid; a label that several share is named once.

    Args:
        panel: matplotlib's.
        lines: what is drawn.
        diagonal: where a grey line of equal x and y begins and ends; None: nowhere.
        axes: what matplotlib's `Axes.set` takes (title, labels, limits).
    """
    if diagonal is not None:
        panel.plot(diagonal, diagonal, color=GREY, linewidth=0.8, zorder=0.9)
    named: set[str] = set()
    for line in lines:
        here = np.ones(len(line.x), bool) if line.gaps else np.isfinite(line.x) & np.isfinite(line.y)
        label = line.label if line.label and line.label not in named else None
        named.add(line.label)
        plain = line.areas is None
        panel.plot(
            line.x[here], line.y[here], color=line.colour, alpha=line.alpha, linestyle=line.style, linewidth=line.width,
            marker=line.marker if plain else "", markersize=line.size, label=label if plain else None,
        )  # fmt: skip
        if line.areas is not None:
            panel.scatter(
                line.x[here], line.y[here], line.areas[here], color=line.colour, marker=line.marker or "o", linewidths=0, label=label
            )
    panel.grid(color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set(**axes)
