"""Figures of what was trained: learning curves, and whether the world model's probabilities come true."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wasp_cli.report.curves import LOSSES, STEPS, Curve, Reliability, driving_curves, loss_curves, reliabilities
from wasp_cli.report.figures.style import PALETTE, drawn, figure_files
from wasp_cli.report.tables.titles import task_title
from wasp_cli.report.trained_table import Trained
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = ("o", "s", "^", "D")
LINES = ("-", "--", "-.", ":")
SMOOTHED = 7
"""Points of a loss that are averaged: a batch is small."""
EPISODES = {"held_out": "held-out episodes", "unseen": "operators not in the data"}


def learning_figure(layout: Layout, trained: Sequence[Trained], folder: Path) -> list[Path]:
    """Write `learning.png` and `.svg`: return and cost of what learns in the task, losses of the world model; a row for each task.

    Returns:
        The written files; none when no artifact keeps a curve.
    """
    driving, losses = driving_curves(layout, trained), loss_curves(layout, trained)
    tasks = list(dict.fromkeys(curve.task for curve in (*driving, *losses)))
    if not tasks:
        return []
    with drawn((9.6, 0.5 + 2.5 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), 3, squeeze=False)
        for row, task in zip(panels, tasks, strict=True):
            own = [curve for curve in driving if curve.task == task]
            _lines(row[0], own, "return", list(dict.fromkeys(curve.name for curve in driving)), 1e-3)
            _lines(row[1], own, "cost_per_1000", list(dict.fromkeys(curve.name for curve in driving)), 1e-3)
            _lines(row[2], [_smoothed(curve) for curve in losses if curve.task == task], "loss", list(LOSSES.values()), 1e-3)
            row[2].set_yscale("log")
            row[0].set_title(f"{task_title(task)}: return per episode", loc="left", fontweight="bold")
            row[1].set_title("Cost per 1000 env steps", loc="left")
            row[2].set_title("World model: loss / first loss", loc="left")
            row[2].set_xlabel("thousand updates")
            for panel in row[:2]:
                panel.set_xlabel("thousand decision steps")
            for panel in (row[0], row[2]):
                if panel.get_legend_handles_labels()[0]:
                    panel.legend(frameon=False, fontsize=7, handlelength=2.4)
        return figure_files(figure, folder, "learning")


def reliability_figure(layout: Layout, trained: Iterable[Trained], folder: Path) -> list[Path]:
    """Write `reliability.png` and `.svg`: how often an imagined cost came true, by its predicted probability; a row for each task.

    Returns:
        The written files; none when no world model was judged.
    """
    found = list(reliabilities(layout, trained))
    tasks = list(dict.fromkeys(each.task for each in found))
    if not tasks:
        return []
    kinds = [episodes for episodes in EPISODES if any(each.episodes == episodes for each in found)]
    with drawn((0.8 + 3.2 * len(kinds), 0.5 + 3.0 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(kinds), squeeze=False, sharex=True, sharey=True)
        for row, task in zip(panels, tasks, strict=True):
            for panel, episodes in zip(row, kinds, strict=True):
                panel.plot([0, 1], [0, 1], color="#999999", linewidth=0.8, zorder=0)
                for each in found:
                    if each.task == task and each.episodes == episodes:
                        _reliability(panel, each)
                panel.set_title(f"{task_title(task)}: {EPISODES[episodes]}", loc="left", fontsize=9)
                panel.set_xlabel("predicted probability of a cost")
            row[0].set_ylabel("share with a cost")
        handles = {label: handle for handle, label in zip(*panels[0, 0].get_legend_handles_labels(), strict=True)}
        figure.legend(
            handles.values(), handles.keys(), loc="outside right upper", frameon=False, title="steps ahead\n(marks grow with\ntheir rows)"
        )
        return figure_files(figure, folder, "reliability")


def _lines(panel: Axes, curves: Sequence[Curve], quantity: str, names: Sequence[str], scale: float) -> None:
    """The curves of a panel; all seeds of a name look the same."""
    labelled: set[str] = set()
    for curve in curves:
        i = names.index(curve.name) if curve.name in names else 0
        values = curve.y[quantity]
        here = np.isfinite(values)  # a rollout in which no episode ended has no return
        panel.plot(
            scale * curve.x[here], values[here], color=PALETTE[i % len(PALETTE)], linestyle=LINES[i % len(LINES)], linewidth=1.2,
            alpha=0.85, label=None if curve.name in labelled else curve.name,
        )  # fmt: skip
        labelled.add(curve.name)
    panel.grid(color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)


def _smoothed(curve: Curve) -> Curve:
    """Means over neighbouring points."""
    width = min(SMOOTHED, len(curve.x))
    middle = curve.x[(width - 1) // 2 :][: len(curve.x) - width + 1]
    return replace(curve, x=middle, y={name: np.convolve(values, np.ones(width) / width, "valid") for name, values in curve.y.items()})


def _reliability(panel: Axes, each: Reliability) -> None:
    i, here = STEPS.index(each.step), each.size > 0
    colour = PALETTE[(1, 6, 3, 4)[i]]
    panel.plot(each.predicted[here], each.seen[here], color=colour, linestyle=LINES[i], linewidth=0.9, alpha=0.8)
    area = 6.0 + 10.0 * np.log10(each.size[here])
    panel.scatter(each.predicted[here], each.seen[here], area, color=colour, marker=MARKERS[i], linewidths=0, label=str(each.step))
