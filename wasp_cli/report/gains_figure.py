"""Figure `gains`: at a predicted gain of x, the realised gain was y. A row for each task, two
columns for each assistant with a model: return gained, and cost saved.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wasp_cli.report.canvas import drawn, figure_files
from wasp_cli.report.gains import QUANTITIES, Foresight, Trust, trusted_groups
from wasp_cli.report.stats import Frame
from wasp_cli.report.styles import GREY, legend, ruled, style_of
from wasp_cli.report.tables import task_title, who_title
from wasp_cli.report.tables.gains import tau_r_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROOM = 0.07  # beside what is drawn, as a share of its span


def gains_figure(frame: Frame, foresight: Foresight, folder: Path) -> list[Path]:
    """Write `gains.png` and `.svg`. Returns the files; none if no intervention has a prediction."""
    shown = [trust for trust in trusted_groups(frame, foresight) if trust.group.variant == "full"]
    if not shown:
        return []
    tasks = list(dict.fromkeys(trust.group.task for trust in shown))
    methods = list(dict.fromkeys(trust.group.method for trust in shown))
    columns = [(method, quantity) for method in methods for quantity in QUANTITIES]
    placed = {(trust.group.task, trust.group.method, trust.quantity): trust for trust in shown}
    with drawn((0.4 + 2.6 * len(columns), 0.7 + 2.7 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(columns), squeeze=False)
        for row, task in zip(panels, tasks, strict=True):
            for panel, (method, quantity) in zip(row, columns, strict=True):
                panel.set_title(f"{task_title(task)}: {who_title(method)}", loc="left", fontsize=8)
                panel.set_xlabel(f"{quantity.title}, predicted")
                trust = placed.get((task, method, quantity))
                if trust is None:
                    _leave_empty(panel)
                else:
                    _draw(panel, trust)
            row[0].set_ylabel("realised")
        legend(figure, panels.flat, most=4, loc="outside lower center")
        return figure_files(figure, folder, "gains")


def _leave_empty(panel: Axes) -> None:
    panel.text(0.5, 0.5, "no prediction\nhere", ha="center", va="center", color=GREY)
    panel.set_xticks([])
    panel.set_yticks([])
    panel.set_box_aspect(1.0)


def _draw(panel: Axes, trust: Trust) -> None:
    colour, marker = style_of(trust.group.method)
    low, high = _reach(trust)

    # The lines of no gain, and of a gain as predicted.
    panel.axhline(0.0, color="black", linewidth=0.8)
    panel.plot([low, high], [low, high], "--", color=GREY, linewidth=0.9, label="as predicted")

    # The gain above which the gate fires, and above which predictions hold.
    tau_r = tau_r_of(trust)
    if tau_r is not None:
        panel.axvline(tau_r, color="black", linewidth=0.9, linestyle=":", label="τ_r")
    if trust.holds is not None:
        panel.axvspan(
            trust.holds,
            high,
            color="#009E73",
            alpha=0.12,
            linewidth=0,
            label="all from here on: mean above 0",
        )

    # The bins, each with its interval and how many interventions it has.
    for each in trust.bins:
        if not math.isnan(each.interval.low):
            panel.plot([each.predicted] * 2, each.interval, color=colour, linewidth=1.4)
        panel.plot(each.predicted, each.realised, marker, color=colour, markersize=6)
        panel.annotate(
            str(each.size),
            (each.predicted, each.realised),
            (4, 4),
            textcoords="offset points",
            fontsize=6,
            color="#555555",
        )
    panel.text(0.03, 0.97, _slope(trust), transform=panel.transAxes, va="top", fontsize=7)

    # One scale for both, so that a flat picture looks flat.
    panel.set_xlim(low, high)
    panel.set_ylim(low, high)
    panel.set_box_aspect(1.0)
    panel.locator_params(nbins=5)
    ruled(panel)


def _slope(trust: Trust) -> str:
    slope = trust.flat.slope
    low, high = trust.flat.slope_interval
    if math.isnan(slope):
        return ""
    limits = "" if math.isnan(low) else f" [{low:.2f}, {high:.2f}]"
    return f"slope {slope:.2f}{limits}"


def _reach(trust: Trust) -> tuple[float, float]:
    """The limits of both axes of a panel: everything that it shows, and 0."""
    numbers = [0.0]
    for each in trust.bins:
        numbers += [each.predicted, each.realised, *each.interval]
    known = np.array(numbers)[np.isfinite(numbers)]
    low = float(known.min())
    high = float(known.max())
    room = ROOM * ((high - low) or 1.0)
    return low - room, high + room
