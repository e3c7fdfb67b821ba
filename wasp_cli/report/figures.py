"""All figures of a report, and what they show in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wasp_cli.report.condition_figures import latency_figure, severity_figure
from wasp_cli.report.figure import cost_return_figure
from wasp_cli.report.frame import Frame
from wasp_cli.report.necessity_figure import necessity_figure
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.figures import learning_figure, reliability_figure
from wasp_cli.store.layout import Layout

CAPTIONS = {
    "cost_return": "Cost against return of every method: large marks are means over the operators, with the spread over seeds, small ones "
    "single operators.",
    "figure3": "What the interventions were worth: how many costly decisions would have followed without them, and what they changed; bars "
    "are 95 % intervals.",
    "severity": "Return, cost and intervention rate under every operator and severity; bars are standard deviations over seeds.",
    "latency": "Time of a decision: the median, and the 95th percentile as a bar. The episodes of a cell are decided side by side.",
    "learning": "Learning curves: what learns in the task, and the losses of the world model (means of neighbouring points).",
    "reliability": "Of the imagined steps that the world model calls costly with some probability, the share that was.",
}
"""By the name of the file, in the order of the page."""


def draw_figures(layout: Layout, frame: Frame, trained: Sequence[Trained], folder: Path) -> list[Path]:
    """Write every figure that has something to show, as PNG and SVG; returns the files."""
    files = cost_return_figure(frame, folder)
    files += necessity_figure(frame, folder)
    files += severity_figure(frame, folder)
    files += latency_figure(frame, folder)
    files += learning_figure(layout, trained, folder)
    files += reliability_figure(layout, trained, folder)
    return files
