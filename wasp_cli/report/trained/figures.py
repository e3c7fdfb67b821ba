"""Figures of all trained parts: learning curves, and whether the world model's probabilities come true.

Curves of artifacts that have no valid form are no curves.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wasp_cli.report.figures.style import PALETTE, Line, draw_lines, drawn, figure_files
from wasp_cli.report.tables.titles import task_title
from wasp_cli.report.trained.artifacts import Floats, Trained, column_of, numbers_of, read_json, rows_of
from wasp_cli.store.layout import Layout

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
    names = list(dict.fromkeys(curve.name for curve in driving))
    with drawn((9.6, 0.5 + 2.5 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), 3, squeeze=False)
        for row, task in zip(panels, tasks, strict=True):
            own = [curve for curve in driving if curve.task == task]
            lost = [_smoothed(curve) for curve in losses if curve.task == task]
            draw_lines(row[0], _lines(own, "return", names), xlabel="thousand decision steps")
            draw_lines(row[1], _lines(own, "cost_per_1000", names), xlabel="thousand decision steps")
            draw_lines(row[2], _lines(lost, "loss", list(LOSSES.values())), xlabel="thousand updates", yscale="log")
            row[0].set_title(f"{task_title(task)}: return per episode", loc="left", fontweight="bold")
            row[1].set_title("Cost per 1000 env steps", loc="left")
            row[2].set_title("World model: loss / first loss", loc="left")
            for panel in (row[0], row[2]):
                if panel.get_legend_handles_labels()[0]:
                    panel.legend(frameon=False, fontsize=7, handlelength=2.4)
        return figure_files(figure, folder, "learning")


def reliability_figure(layout: Layout, trained: Iterable[Trained], folder: Path) -> list[Path]:
    """Write `reliability.png` and `.svg`: how often an imagined cost came true, by its predicted probability; a row for each task.

    Returns:
        The written files; none when no world model was judged.
    """
    diagrams = list(reliabilities(layout, trained))
    tasks = list(dict.fromkeys(each.task for each in diagrams))
    if not tasks:
        return []
    kinds = [episodes for episodes in EPISODES if any(each.episodes == episodes for each in diagrams)]
    with drawn((0.8 + 3.2 * len(kinds), 0.5 + 3.0 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(kinds), squeeze=False, sharex=True, sharey=True)
        for row, task in zip(panels, tasks, strict=True):
            for panel, episodes in zip(row, kinds, strict=True):
                own = [_reliability(each) for each in diagrams if each.task == task and each.episodes == episodes]
                draw_lines(panel, own, diagonal=(0.0, 1.0), xlabel="predicted probability of a cost")
                panel.grid(visible=False)
                panel.set_title(f"{task_title(task)}: {EPISODES[episodes]}", loc="left", fontsize=9)
            row[0].set_ylabel("share with a cost")
        handles = {label: handle for handle, label in zip(*panels[0, 0].get_legend_handles_labels(), strict=True)}
        figure.legend(
            handles.values(), handles.keys(), loc="outside right upper", frameon=False, title="steps ahead\n(marks grow with\ntheir rows)"
        )
        return figure_files(figure, folder, "reliability")


def _lines(curves: Sequence[Curve], quantity: str, names: Sequence[str]) -> Iterator[Line]:
    """All seeds of a name look the same. A rollout in which no episode ended has no return."""
    for curve in curves:
        i = names.index(curve.name) if curve.name in names else 0
        yield Line(1e-3 * curve.x, curve.y[quantity], curve.name, PALETTE[i % len(PALETTE)], LINES[i % len(LINES)], alpha=0.85)


def _smoothed(curve: Curve) -> Curve:
    """Means over neighbouring points."""
    width = min(SMOOTHED, len(curve.x))
    middle = curve.x[(width - 1) // 2 :][: len(curve.x) - width + 1]
    return replace(curve, x=middle, y={name: np.convolve(values, np.ones(width) / width, "valid") for name, values in curve.y.items()})


def _reliability(each: Reliability) -> Line:
    i, here = STEPS.index(each.step), each.size > 0
    colour, areas = PALETTE[(1, 6, 3, 4)[i]], 6.0 + 10.0 * np.log10(each.size[here])
    x, y = each.predicted[here], each.seen[here]
    return Line(x, y, str(each.step), colour, LINES[i], MARKERS[i], width=0.9, areas=areas, alpha=0.8)


DRIVING = {
    "expert": ("curve.json", "Expert"),
    "policies": ("reinforcement.json", "Latent expert"),
    "residual": ("curve.json", "SafeRL-Res"),
}
"""Stages that learn in the task: file of the curve, name in figures."""
LOSSES = {"beta_o": "images", "beta_r": "reward", "beta_c": "cost", "ahead_c": "cost, imagined"}
"""Terms of the world model's loss (Eq. 6 and the imagined one) that a figure shows."""
UPDATES_PER_POINT = 20
"""Of the world model's curves."""
STEPS = (1, 5, 10, 15)
"""Imagined steps whose reliability a figure shows."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a figure."""

    task: str
    seed: int
    name: str
    x: Floats
    y: Mapping[str, Floats]
    """By quantity; NaN is a gap."""


class Reliability(NamedTuple):
    """How often what the world model predicts with some probability comes true, of one seed at one imagined step."""

    task: str
    seed: int
    episodes: str
    """`held_out` or `unseen`"""
    step: int
    predicted: Floats
    """[bins]"""
    seen: Floats
    """[bins]"""
    size: Floats
    """[bins] rows behind them"""


def driving_curves(layout: Layout, trained: Iterable[Trained]) -> list[Curve]:
    """Read return per episode (`return`) and cost per 1000 env steps (`cost_per_1000`) over the decision steps of the training."""
    curves = []
    for artifact in trained:
        if artifact.kind not in DRIVING:
            continue
        file, name = DRIVING[artifact.kind]
        rows = rows_of(read_json(layout, artifact, file))
        x = column_of(rows, "interactions")
        if len(x) > 1 and np.isfinite(x).all():
            numbers = {key: column_of(rows, key) for key in ("return", "cost_per_1000")}
            curves.append(Curve(artifact.task, artifact.seed, name, x, numbers))
    return curves


def loss_curves(layout: Layout, trained: Iterable[Trained]) -> list[Curve]:
    """Read the losses of the world model by LOSSES over its updates, each divided by its first value."""
    losses = []
    for artifact in trained:
        if artifact.kind != "world_model":
            continue
        curves = read_json(layout, artifact, "curves.json")
        if not isinstance(curves, dict):
            continue
        terms = {title: numbers_of(curves.get(term)) for term, title in LOSSES.items()}
        terms = {title: values / values[0] for title, values in terms.items() if len(values) > 1 and values[0] > 0}
        for title, values in terms.items():
            x = UPDATES_PER_POINT * np.arange(len(values), dtype=np.float64)
            losses.append(Curve(artifact.task, artifact.seed, title, x, {"loss": values}))
    return losses


def reliabilities(layout: Layout, trained: Iterable[Trained]) -> Iterator[Reliability]:
    """Read how reliable the cost head is along imagined rollouts, at STEPS, where `diagnostics` has judged it."""
    for artifact in [artifact for artifact in trained if artifact.kind == "diagnostics"]:
        document = read_json(layout, artifact, "diagnostics.json")
        for episodes in ("held_out", "unseen"):
            part = document.get(episodes) if isinstance(document, dict) else None
            for row in rows_of(part.get("steps") if isinstance(part, dict) else None):
                if (step := row.get("k")) in STEPS:
                    bins = rows_of(row.get("reliability"))
                    columns = [column_of(bins, name) for name in ("predicted", "seen", "size")]
                    if bins:
                        yield Reliability(artifact.task, artifact.seed, episodes, int(step), *columns)
