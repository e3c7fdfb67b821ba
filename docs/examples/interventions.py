"""At equal effective interventions, who costs less? Draw Table 1's assistants and the published
curves of their knobs over one axis, from the published rows.

python docs/examples/interventions.py
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import curves
import pyarrow as pa
import pyarrow.parquet as pq
import reproduction

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.canvas import drawn
from wasp_cli.report.figures import rows_by_task
from wasp_cli.report.interventions_figure import (
    OURS,
    Point,
    draw_points,
    name_points,
    points_of,
    square_root_axis,
)
from wasp_cli.report.labels import Named, name_marks
from wasp_cli.report.styles import ruled, style_of
from wasp_cli.tasks.registry import TASKS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURE = reproduction.ROOT / "docs" / "pictures" / "interventions.png"
Curve = Sequence[tuple[float, float]]
"""Effective intervention rate and cost at each value of a knob."""


def points() -> dict[str, list[Point]]:
    """Return what Table 1's assistants come to on each task, with intervals."""
    return {task: points_of(rows) for task, rows in rows_by_task(reproduction.frame()).items()}


def curves_of(rows: pa.Table, task: str) -> dict[str, Curve]:
    """Return the curve of every assistant that was measured on a task."""
    found = {}
    for method, knob in curves.measured_in(rows):
        measured = [curves.point(rows, task, method, value) for value in knob.values]
        found[method] = [(each["effective"], each["cost"]) for each in measured]
    return found


def draw_curves(panel: Axes, rows: pa.Table, task: str) -> list[Named]:
    """Draw the curves of a task; return their marks at the values that Table 1 uses."""
    used = []
    for method, curve in curves_of(rows, task).items():
        colour, marker = style_of(method)
        at = curves.point(rows, task, method, curves.KNOBS[method].used)
        panel.plot(*zip(*curve, strict=True), color=colour, linewidth=1.0, marker=".", markersize=3)
        panel.plot(at["effective"], at["cost"], marker, color=colour, markeredgecolor="white")
        title = METHODS[method].title
        used.append(Named(at["effective"], at["cost"], title, bold=method == OURS))
    ruled(panel)
    return used


def draw(path: Path) -> None:
    """Write the picture: a column for each task, Table 1 above the curves."""
    table = points()
    rows = pq.read_table(curves.published("field"))
    with drawn((0.5 + 4.0 * len(table), 8.2)) as figure:
        panels = figure.subplots(2, len(table), squeeze=False)
        marks = {}
        for above, below, (task, shown) in zip(*panels, table.items(), strict=True):
            draw_points(above, shown)
            above.set_title(
                f"{TASKS[task].title}: five trainings", loc="left", fontweight="bold", fontsize=9
            )
            marks[task] = draw_curves(below, rows, task)
            square_root_axis(
                below, max(y for each in curves_of(rows, task).values() for _, y in each)
            )
            below.set_xlim(left=0.0)
            below.set_title("Training 1, other worlds: every knob turned", loc="left", fontsize=9)
            below.set_xlabel("Share of decisions with an effective intervention")
        for row in panels:
            row[0].set_ylabel("Cost per episode (better: down; square-root axis)")
        figure.draw_without_rendering()  # lays the panels out: names are placed in pixels
        for above, below, (task, shown) in zip(*panels, table.items(), strict=True):
            name_points(above, shown)
            lines = [
                segment for curve in curves_of(rows, task).values() for segment in pairwise(curve)
            ]
            name_marks(below, marks[task], lines)
        figure.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(PICTURE)
