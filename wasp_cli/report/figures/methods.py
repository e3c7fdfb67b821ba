"""Figures with a mark for each method: cost against return, and how long a decision takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.figures.style import drawn, figure_files, legend, ruled, style_of
from wasp_cli.report.stats.frame import CellNumbers, Frame, Group, groups
from wasp_cli.report.stats.summary import summarise
from wasp_cli.report.tables.titles import assistant_title, task_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
            ruled(panel)
        panels[0].set_ylabel("Return per episode (better: up)")
        legend(figure, panels, loc="outside right upper", title="large: mean\nsmall: one operator\n")
        return figure_files(figure, folder, "cost_return")


def latency_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `latency.png` and `.svg`: median and 95th percentile of the time of a decision, a panel for each task.

    Returns:
        The written files; none when no cell has been computed.
    """
    found = [group for group in groups(frame) if group.assistant_variant == "full" and group.cells]
    tasks = list(dict.fromkeys(group.task for group in found))
    if not tasks:
        return []
    most = max(sum(group.task == task for group in found) for task in tasks)
    with drawn((1.4 + 3.0 * len(tasks), 0.9 + 0.32 * most)) as figure:
        panels = figure.subplots(1, len(tasks), squeeze=False)[0]
        for panel, task in zip(panels, tasks, strict=True):
            own = [group for group in found if group.task == task]
            for y, group in enumerate(own):
                _latency(panel, group, y)
            panel.set_yticks(range(len(own)), [assistant_title(group) for group in own])
            panel.invert_yaxis()
            panel.set_xscale("log")
            panel.set_title(task_title(task), loc="left", fontweight="bold")
            panel.set_xlabel("ms per decision: median (mark), 95 % (bar)")
            ruled(panel, "x")
        return figure_files(figure, folder, "latency")


def _draw(panel: Axes, group: Group) -> None:
    """One method: its operator variants small, their mean large with the spread over seeds."""
    colour, marker = style_of(group.method)
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


def _latency(panel: Axes, group: Group, y: int) -> None:
    median, late = (summarise(group.cells, f"decision_{share}_ms").mean for share in ("p50", "p95"))
    if median is None or late is None or median <= 0:
        return
    colour, marker = style_of(group.method)
    panel.plot([median, max(late, median)], [y, y], color=colour, linewidth=1.6)
    panel.plot([late], [y], "|", color=colour, markersize=9)
    panel.plot([median], [y], marker, color=colour, markersize=6)
