"""Figure 3 of the paper: what the interventions were worth, one row of panels per task."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wasp_cli.report.figures.style import drawn, figure_files, ruled, style_of
from wasp_cli.report.stats.frame import Floats, Frame, Group
from wasp_cli.report.tables.necessity import MEANS, estimated, judged_groups, row_title
from wasp_cli.report.tables.table import Column
from wasp_cli.report.tables.titles import task_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CLASSES = (("no cost", "#f2f2f2"), ("up to 1/3", "#bdbdbd"), ("up to 2/3", "#737373"), ("more", "#1a1a1a"))
"""Classes of the risk, by the share of the W decisions that cost; greys that rise with it survive any printer."""
PANELS = {
    "uir": "Unnecessary: UIR\n(better: left)",
    "delta_c": "Costly decisions\navoided: ΔC (better: right)",
    "delta_r": "Reward gained: ΔR\n(better: right)",
}


def necessity_figure(frame: Frame, folder: Path) -> list[Path]:
    """Write `figure3.png` and `.svg`: the risk at interventions, UIR, Delta C and Delta R of every method, with intervals.

    Args:
        frame: with branches (`report.stats.branches.with_branches`).
        folder: where the files go.

    Returns:
        The written files; none where no intervention was branched.
    """
    found = [group for group in judged_groups(frame) if _risks(frame, group).size]
    if not found:
        return []
    tasks = [(task, list(own)) for task, own in groupby(found, lambda group: group.task)]
    columns = {column.key: column for column in MEANS}
    heights = [0.34 * len(own) + 0.5 for _, own in tasks]
    with drawn((10.0, 1.3 + sum(heights))) as figure:
        panels = figure.subplots(
            len(tasks), 1 + len(PANELS), squeeze=False, sharey="row", width_ratios=[1.7, 1, 1, 1], height_ratios=heights
        )
        for row, (task, own) in zip(panels, tasks, strict=True):
            risk, *others = row
            _risk_panel(risk, frame, own)
            risk.set_title(task_title(task), loc="left", fontweight="bold")
            for panel, key in zip(others, PANELS, strict=True):
                _points(panel, own, columns[key])
        for panel, text in zip(
            panels[-1], ("Share of the interventions by the risk ρ\nof the command alone", *PANELS.values()), strict=True
        ):
            panel.set_xlabel(text)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=len(CLASSES), frameon=False, title=_what_rho_is(frame))
        return figure_files(figure, folder, "figure3")


def _risks(frame: Frame, group: Group) -> Floats:
    """rho of every branched intervention of a row."""
    return np.concatenate([frame.judged[cell.identity].worth.rho for cell in group.cells]) if group.cells else np.empty(0)


def _what_rho_is(frame: Frame) -> str:
    windows = " or ".join(map(str, sorted({judged.window for judged in frame.judged.values()})))
    return f"ρ: share of the next {windows} decisions that cost without the intervention"


def _risk_panel(panel: Axes, frame: Frame, own: Sequence[Group]) -> None:
    """Stacked shares of the classes of risk; beside them how many interventions they are made from."""
    edges = np.array([0.0, 1 / 3, 2 / 3])
    for y, group in enumerate(own):
        risks = _risks(frame, group)
        place = np.searchsorted(edges, risks - 1e-9, side="left")  # k / W on an edge belongs below it
        left = 0.0
        for k, (name, grey) in enumerate(CLASSES):
            share = 100.0 * float((place == k).mean())
            panel.barh(y, share, 0.62, left=left, color=grey, edgecolor="black", linewidth=0.6, label=name if y == 0 else None)
            left += share
        panel.annotate(f"n = {len(risks)}", (100.0, y), (4, 0), textcoords="offset points", va="center", fontsize=7, color="#555555")
    panel.set_xlim(0.0, 116.0)
    panel.set_xticks(range(0, 101, 25), [f"{tick} %" for tick in range(0, 101, 25)])
    panel.set_yticks(range(len(own)), [row_title(group) for group in own])
    panel.set_ylim(len(own) - 0.5, -0.5)
    panel.tick_params(axis="y", length=0)


def _points(panel: Axes, own: Sequence[Group], column: Column) -> None:
    """A mark per method with its interval."""
    for y, group in enumerate(own):
        value = estimated(group, column)
        if value.mean is None:
            continue
        colour, marker = style_of(group.method)
        if value.interval is not None:
            panel.plot([value.interval.low, value.interval.high], [y, y], color=colour, linewidth=1.6, solid_capstyle="butt")
        panel.plot(value.mean, y, marker, color=colour, markersize=8, markeredgecolor="white")
    if column.key == "uir":
        panel.set_xlim(-0.05, 1.05)  # so that a mark at an end is whole
        panel.set_xticks([0.0, 0.5, 1.0])
    else:
        panel.locator_params(axis="x", nbins=4)
        panel.axvline(0.0, color="black", linewidth=0.8)
    panel.spines["left"].set_visible(False)
    ruled(panel, "x")
    panel.tick_params(axis="y", length=0)
