"""Figure `cost_interventions`: what assistants cost against how often they act in effect.

A panel for each task. An assistant that acts more often has more occasions to avoid a cost, so
costs are comparable where the shares of effective interventions are alike: on one vertical line.
Both numbers have the hierarchical 95 % intervals over trainings and worlds of
`bootstrap.contrast_of`. Each mark has its name beside it, so that nothing depends on colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.bootstrap import Limits, contrast_of
from wasp_cli.report.canvas import drawn, figure_files
from wasp_cli.report.figures import rows_by_task
from wasp_cli.report.labels import Named, name_marks
from wasp_cli.report.stats import Frame, Group
from wasp_cli.report.styles import GREY, ruled, style_of
from wasp_cli.report.tables import assistant_title, task_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REFERENCE = "human"
OURS = "wasp"
TICKS = tuple(step * 10.0**power for power in range(-2, 5) for step in (1, 2, 5))


@dataclass(frozen=True)
class Measured:
    """A number with the limits of its 95 % interval, where there is one."""

    value: float
    limits: Limits | None

    @property
    def bars(self) -> tuple[float, float]:
        """Return how far the interval reaches below and above the value."""
        if self.limits is None:
            return 0.0, 0.0
        low, high = self.limits
        return max(self.value - low, 0.0), max(high - self.value, 0.0)


@dataclass(frozen=True)
class Point:
    """An assistant on a task."""

    method: str
    title: str
    rate: Measured  # share of the decisions at which an action changed a force
    cost: Measured  # of an episode


def points_of(rows: Sequence[Group]) -> list[Point]:
    """Return the points of one task: the operators alone and every assistant.

    References that no operator commands are left out, and so are rows of earlier versions, which do
    not have `int_eff`.
    """
    points = []
    for group in rows:
        info = METHODS[group.method]
        if not info.impaired or not info.attended:
            continue
        rate = _measured(group, "int_eff")
        cost = _measured(group, "cost")
        if rate is not None and cost is not None:
            points.append(Point(group.method, assistant_title(group), rate, cost))
    return points


def _measured(group: Group, key: str) -> Measured | None:
    contrast = contrast_of(group.cells, 0.0, key)
    if contrast is None:
        return None
    return Measured(contrast.value, contrast.bootstrap)


def cost_interventions_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `cost_interventions.png` and `.svg`. Returns the files; none if no assistant has
    effective interventions.
    """
    shown = {}
    for task, rows in rows_by_task(frame).items():
        points = points_of(rows)
        if any(point.method != REFERENCE for point in points):
            shown[task] = points
    if not shown:
        return []
    with drawn((0.5 + 4.0 * len(shown), 4.2)) as figure:
        panels = figure.subplots(1, len(shown), squeeze=False)[0]
        for panel, (task, points) in zip(panels, shown.items(), strict=True):
            draw_points(panel, points)
            panel.set_title(task_title(task), loc="left", fontweight="bold")
            panel.set_xlabel("Share of decisions with an effective intervention")
        panels[0].set_ylabel("Cost per episode (better: down; square-root axis)")
        figure.draw_without_rendering()  # lays the panels out: names are placed in pixels
        for panel, points in zip(panels, shown.values(), strict=True):
            name_points(panel, points)
        return figure_files(figure, folder, "cost_interventions")


def draw_points(panel: Axes, points: Sequence[Point]) -> None:
    """Draw the marks of a task with their intervals, and the operators alone as a line."""
    for point in points:
        colour, marker = style_of(point.method)
        if point.method == REFERENCE:
            panel.axhline(point.cost.value, color=GREY, linewidth=1.0, linestyle="--")
            if point.cost.limits is not None:
                panel.axhspan(*point.cost.limits, color=GREY, alpha=0.15, linewidth=0)
            continue
        panel.errorbar(
            point.rate.value,
            point.cost.value,
            xerr=np.array([point.rate.bars]).T,
            yerr=np.array([point.cost.bars]).T,
            fmt=marker,
            color=colour,
            markersize=8,
            markeredgecolor="white",
            elinewidth=0.9,
            capsize=2,
        )
    reach = [point.cost.value + point.cost.bars[1] for point in points]
    square_root_axis(panel, max(reach))
    panel.set_xlim(left=0.0)
    ruled(panel)


def square_root_axis(panel: Axes, most: float) -> None:
    """Give a panel a square-root axis from 0 to `most`, which spreads small costs and still has
    0.
    """
    top = 1.05 * most or 1.0
    panel.set_yscale("function", functions=(lambda y: np.sqrt(np.maximum(y, 0.0)), np.square))
    panel.set_ylim(0.0, top)
    ticks = [0.0]
    for tick in TICKS:
        if tick <= top and np.sqrt(tick) - np.sqrt(ticks[-1]) >= 0.07 * np.sqrt(top):
            ticks.append(tick)
    panel.set_yticks(ticks, [f"{tick:g}" for tick in ticks])


def name_points(panel: Axes, points: Sequence[Point]) -> None:
    """Write the names of a task's points into its panel, once that is laid out."""
    marks = []
    lines = []
    for point in points:
        x = point.rate.value
        y = point.cost.value
        if point.method == REFERENCE:
            name_reference(panel, point.title, y)
            continue
        marks.append(Named(x, y, point.title, bold=point.method == OURS))
        less, more = point.rate.bars
        lines.append(((x - less, y), (x + more, y)))
        less, more = point.cost.bars
        lines.append(((x, y - less), (x, y + more)))
    name_marks(panel, marks, lines)


def name_reference(panel: Axes, title: str, cost: float) -> None:
    """Write whose cost the line across a panel is, at its right end."""
    text = panel.annotate(
        title,
        (1.0, cost),
        (-2, 2),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=7,
        color="#555555",
    )
    text.set_in_layout(False)
