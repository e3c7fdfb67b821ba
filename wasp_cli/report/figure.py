"""Figures of a report: how all of them look and are written, and cost against return, one panel per task."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.frame import CellNumbers, Frame, Group, groups
from wasp_cli.report.statistics import summarise
from wasp_cli.report.titles import assistant_title, task_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#CC79A7", "#0072B2")
"""Okabe and Ito: distinguishable with every common colour blindness. `wasp` is vermilion."""

METHOD_MARKERS = ("o", "s", "^", "v", "D", "P", "X")
ENDINGS = ("png", "svg")
STYLES = {name: (PALETTE[i % len(PALETTE)], METHOD_MARKERS[i % len(METHOD_MARKERS)]) for i, name in enumerate(METHODS)}
"""Colour and marker of a method, the same in every figure; the marker also tells them apart in print."""
LOOK: dict[Any, Any] = {
    "font.size": 9,
    "svg.hashsalt": "wasp",
    "svg.fonttype": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
}
"""Settings of matplotlib for every figure."""


def cost_return_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `cost_return.png` and `.svg`: large marks are a method's mean, small ones its operator variants.

    Returns:
        The written files; none when no cell has been computed.
    """
    found = [group for group in groups(frame) if group.assistant_variant == "full" and group.cells]
    if not found:
        return []
    tasks = list(dict.fromkeys(group.task for group in found))
    with drawn((1.6 + 3.4 * len(tasks), 3.6)) as figure:
        panels = figure.subplots(1, len(tasks), squeeze=False)[0]
        for panel, task in zip(panels, tasks, strict=True):
            for group in found:
                if group.task == task:
                    _draw(panel, group)
            panel.set_title(task_title(task), loc="left", fontweight="bold")
            panel.set_xlabel("Cost per episode (better: left)")
            panel.grid(color="#dddddd", linewidth=0.6)
            panel.set_axisbelow(True)
        panels[0].set_ylabel("Return per episode (better: up)")
        handles = {label: handle for panel in panels for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
        figure.legend(
            handles.values(), handles.keys(), loc="outside right upper", frameon=False, title="large: mean\nsmall: one operator\n"
        )
        return figure_files(figure, folder, "cost_return")


@contextmanager
def drawn(size: tuple[float, float]) -> Iterator[Figure]:
    """An empty figure of `size` (inches), to be filled and written inside the block, where LOOK is in force."""
    # Imported here: matplotlib takes most of a second, and most commands draw nothing.
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(LOOK):
        figure = Figure(figsize=size, layout="constrained", dpi=160)
        FigureCanvasAgg(figure)
        yield figure


def figure_files(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as `name.png` and `name.svg`."""
    return save(figure, [folder / f"{name}.{ending}" for ending in ENDINGS])


def save(figure: Figure, files: Sequence[Path]) -> list[Path]:
    """Write a figure as PNG and as SVG. Without dates and versions, the same numbers give the same bytes."""
    png, svg = files
    figure.savefig(png, metadata={"Software": None})
    figure.set_layout_engine("none")  # what has been laid out stays where it is: doing it again takes as long as drawing
    figure.savefig(svg, metadata={"Date": None, "Creator": None})
    return [png, svg]


def _draw(panel: Axes, group: Group) -> None:
    """One method: its operator variants small, their mean large with the spread over seeds."""
    colour, marker = STYLES.get(group.method, (PALETTE[0], "o"))
    x, y = _point(group.cells)
    for variant in dict.fromkeys(cell.identity.variant for cell in group.cells) if METHODS[group.method].impaired else ():
        small_x, small_y = _point(group.of_variant(variant))
        panel.plot([x, small_x], [y, small_y], color=colour, alpha=0.25, linewidth=0.8)
        panel.plot(small_x, small_y, marker, color=colour, markersize=4, alpha=0.55, markeredgewidth=0)
    cost_sd, return_sd = summarise(group.cells, "cost").sd, summarise(group.cells, "return").sd
    # Larger, so that it shows behind an assistant that never acts.
    size = 12 if group.method == "human" else 9
    panel.errorbar(
        x, y, xerr=cost_sd, yerr=return_sd, fmt=marker, color=colour, markersize=size, markeredgecolor="white", capsize=2, elinewidth=1,
        label=assistant_title(group),
    )  # fmt: skip


def _point(cells: Sequence[CellNumbers]) -> tuple[float, float]:
    """Mean cost and mean return."""
    cost, reward = summarise(cells, "cost").mean, summarise(cells, "return").mean
    return (math.nan if cost is None else cost, math.nan if reward is None else reward)
