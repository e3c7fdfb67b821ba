"""How all figures of a report look, what they are called, how lines are drawn, and how figures are written."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.trained import Floats
from wasp_cli.store.artifact import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


PALETTE = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#CC79A7", "#0072B2")
"""Okabe and Ito: distinguishable with every common colour blindness. `wasp` is vermilion."""

METHOD_MARKERS = ("o", "s", "^", "v", "D", "P", "X")
ENDINGS = ("png", "svg")
# The markers move on by one with every round of the colours, or the eighth method would look like the first.
STYLES = {  # colour and marker of a method, the same in every figure; the marker also tells them apart in print
    name: (PALETTE[i % len(PALETTE)], METHOD_MARKERS[(i + i // len(PALETTE)) % len(METHOD_MARKERS)]) for i, name in enumerate(METHODS)
}
LINES = ("-", "--", ":")  # of methods with one colour, in their rounds
LOOK: dict[Any, Any] = {  # settings of matplotlib for every figure
    "font.size": 9,
    "svg.hashsalt": "wasp",
    "svg.fonttype": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
}
CAPTIONS = {  # by the name of the file, in the order of the page
    "cost_return": "Cost against return of every method: large marks are means over the operators, with the spread over seeds, small ones "
    "single operators.",
    "figure3": "What the interventions were worth: how many costly decisions would have followed without them, and what they changed; bars "
    "are the limits of the table.",
    "severity": "Return, cost and intervention rate under every operator and severity; bars are standard deviations over seeds.",
    "profile": "Performance profiles: the share of episodes that return at least x, and that cost at most x; every operator and seed "
    "weighs the same.",
    "latency": "Time of a decision: the median, and the 95th percentile as a bar. The episodes of a cell are decided side by side.",
    "learning": "Learning curves: what learns in the task, and the losses of the world model (means of neighbouring points).",
    "reliability": "Of the imagined steps that the world model calls costly with some probability, the share that was.",
}


@contextmanager
def drawn(size: tuple[float, float]) -> Iterator[Figure]:
    """Yield an empty figure of `size` (inches), to be filled inside the block, where LOOK is in force."""
    # Imported here: matplotlib takes most of a second, and most commands draw nothing.
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(LOOK):
        figure = Figure(figsize=size, layout="constrained", dpi=160)
        FigureCanvasAgg(figure)
        yield figure


def figure_files(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as `name.png` and `name.svg`. Without dates and versions, the same numbers give the same bytes."""
    png, svg = (folder / f"{name}.{ending}" for ending in ENDINGS)
    save(figure, png)
    figure.set_layout_engine("none")  # what has been laid out stays where it is: doing it again takes as long as drawing
    save(figure, svg)
    return [png, svg]


def save(figure: Figure, path: Path) -> None:
    """Write a figure: whole, or not at all where the process is killed meanwhile."""
    from matplotlib import rc_context

    drawing, dated = BytesIO(), ("Software",) if path.suffix == ".png" else ("Date", "Creator")
    with rc_context(LOOK):
        figure.savefig(drawing, format=path.suffix[1:], metadata=dict.fromkeys(dated))
    replace_file(path, drawing.getvalue())


def style_of(method: str) -> tuple[str, str]:
    """Return the colour and the marker of a method, the same in every figure; the marker also tells them apart in print."""
    return STYLES.get(method, (PALETTE[0], METHOD_MARKERS[0]))


def place_of_round(method: str) -> int:
    """Return in which round of the colours a method is, for LINES."""
    known = list(METHODS)
    return known.index(method) // len(PALETTE) % len(LINES) if method in known else 0


def ruled(panel: Axes, axis: Literal["both", "x", "y"] = "both") -> None:
    """Rule light lines behind what a panel shows."""
    panel.grid(axis=axis, color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)


def legend(
    figure: Figure, panels: Iterable[Axes], further: Mapping[str, Mapping[str, Any]] | None = None, most: int = 0, **options: Any
) -> None:
    """Set one legend for some panels: each label once, then the lines of `further` by label.

    `most` is the number of entries in a row at most, spread evenly over as many rows as the width needs; 0: one below the other.
    """
    from matplotlib.lines import Line2D

    handles = {label: handle for panel in panels for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    handles |= {label: Line2D([], [], **look) for label, look in (further or {}).items()}
    rows = math.ceil(len(handles) / most) if most else len(handles)
    while handles:
        shown = figure.legend(handles.values(), handles.keys(), frameon=False, ncols=math.ceil(len(handles) / rows), **options)
        if rows >= len(handles) or shown.get_window_extent().width <= MARGIN * figure.bbox.width:
            break
        shown.remove()
        rows += 1


GREY = "#999999"
MARGIN = 0.97  # of a figure's width that a legend may take


@dataclass(frozen=True, eq=False)
class Line:
    """One line of a panel."""

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


def draw_lines(panel: Axes, lines: Iterable[Line], *, diagonal: tuple[float, float] | None = None, **axes: Any) -> None:
    """Draw lines over a grid, and a grey line of equal x and y from one to the other end of `diagonal`; a shared label is named once."""
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
    ruled(panel)
    panel.set(**axes)
