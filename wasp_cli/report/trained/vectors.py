"""Pictures of what a world model of vectors sees and imagines: components over time, and what is
decoded beside what came. K = steps of a window, S = components.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from wasp_cli.cells.table import Floats
from wasp_cli.report.canvas import drawn, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHOWN = 8  # components that are drawn at most: those in which most happens
RED = "#d62728"
BLUE = "#1f77b4"
INK = "#141414"
# of a panel, in inches
WIDTH = 2.3
HEIGHT = 1.7


class VectorWindow(NamedTuple):
    """K steps of an episode, or K steps of many."""

    title: str
    true: Floats  # [K, S] in the task's own units
    model: Floats  # [K, S] decoded or imagined
    cost: Floats  # [K] real cost
    predicted: Floats  # [K] probability of a cost


def moving_components(windows: Sequence[VectorWindow]) -> list[int]:
    """Return at most SHOWN components, in ascending order: those whose change within windows is the
    largest share of their range over all windows.
    """
    whole = np.concatenate([window.true for window in windows])
    spread = np.ptp(whole, axis=0)
    change = np.mean([np.ptp(window.true, axis=0) for window in windows], axis=0)
    share = np.divide(change, spread, out=np.zeros_like(change), where=spread > 0)
    most = np.argsort(-share, kind="stable")[:SHOWN]
    moving = [int(component) for component in sorted(most) if share[component] > 0]
    return moving or [0]


def draw_decoded(decoded: VectorWindow, path: Path) -> None:
    """Write a panel for each of some components: decoded values against true ones, those of costly
    steps in red. Right values lie on the diagonal.
    """
    spread = np.ptp(decoded.true, axis=0)
    components = [int(each) for each in np.flatnonzero(spread > 0)[:SHOWN]] or [0]
    costly = decoded.cost > 0
    with drawn((WIDTH * len(components), WIDTH)) as figure:
        panels = figure.subplots(1, len(components), squeeze=False)[0]
        for panel, component in zip(panels, components, strict=True):
            true = decoded.true[:, component]
            model = decoded.model[:, component]
            low = float(true.min())
            high = float(true.max())
            panel.plot([low, high], [low, high], color="#bbbbbb", linewidth=0.8)
            for which, colour in ((~costly, BLUE), (costly, RED)):
                panel.plot(true[which], model[which], ".", color=colour, markersize=3)
            panel.set_title(f"component {component}", fontsize=8)
            panel.set_xlabel("true", fontsize=7)
        panels[0].set_ylabel("decoded", fontsize=7)
        save(figure, path)


def draw_imagined(windows: Sequence[VectorWindow], path: Path) -> None:
    """Write a row for each window: true and imagined components over its steps, and the predicted
    cost. Steps that really cost are marked in red.
    """
    components = moving_components(windows)
    columns = len(components) + 1
    with drawn((WIDTH * columns, (HEIGHT + 0.2) * len(windows))) as figure:
        rows = figure.subplots(len(windows), columns, squeeze=False)
        for row, window in zip(rows, windows, strict=True):
            steps = np.arange(len(window.cost))
            for panel, component in zip(row, components, strict=False):
                panel.plot(steps, window.true[:, component], color=INK, linewidth=1.2, label="came")
                panel.plot(
                    steps,
                    window.model[:, component],
                    color=BLUE,
                    linestyle="--",
                    linewidth=1.2,
                    label="imagined",
                )
                panel.set_xlabel(f"component {component}", fontsize=7)
                _mark_costs(panel, window)
            last = row[-1]
            last.plot(steps, window.predicted, color=BLUE, linewidth=1.2)
            last.set_ylim(0.0, 1.0)
            last.set_xlabel("predicted cost", fontsize=7)
            _mark_costs(last, window)
            row[0].set_title(
                f"{window.title}: seen at 0, then {len(steps) - 1} steps imagined under the true "
                "actions",
                loc="left",
                fontsize=8,
            )
        rows[0][0].legend(frameon=False, fontsize=6)
        save(figure, path)


def _mark_costs(panel: Axes, window: VectorWindow) -> None:
    for step in np.flatnonzero(window.cost > 0).tolist():
        panel.axvspan(step - 0.5, step + 0.5, color=RED, alpha=0.15, linewidth=0)
