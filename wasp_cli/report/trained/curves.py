"""The learning and calibration curves that trained artifacts keep. What has no valid form is no curve."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.read import Floats, column_of, numbers_of, read_json, rows_of
from wasp_cli.store.layout import Layout

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
    found = []
    for artifact in trained:
        if artifact.kind not in DRIVING:
            continue
        file, name = DRIVING[artifact.kind]
        rows = rows_of(read_json(layout, artifact, file))
        x = column_of(rows, "interactions")
        if len(x) > 1 and np.isfinite(x).all():
            numbers = {key: column_of(rows, key) for key in ("return", "cost_per_1000")}
            found.append(Curve(artifact.task, artifact.seed, name + _round(artifact), x, numbers))
    return found


def loss_curves(layout: Layout, trained: Iterable[Trained]) -> list[Curve]:
    """Read the losses of the world model by LOSSES over its updates, each divided by its first value."""
    found = []
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
            found.append(Curve(artifact.task, artifact.seed, title + _round(artifact), x, {"loss": values}))
    return found


def reliabilities(layout: Layout, trained: Iterable[Trained]) -> Iterator[Reliability]:
    """Read how reliable the cost head is along imagined rollouts, at STEPS, where `diagnostics` has judged it; of the last round."""
    judged = [artifact for artifact in trained if artifact.kind == "diagnostics"]
    last = {(artifact.task, artifact.seed): artifact for artifact in sorted(judged, key=lambda artifact: artifact.round)}
    for artifact in last.values():
        document = read_json(layout, artifact, "diagnostics.json")
        for episodes in ("held_out", "unseen"):
            part = document.get(episodes) if isinstance(document, dict) else None
            for row in rows_of(part.get("steps") if isinstance(part, dict) else None):
                if (step := row.get("k")) in STEPS:
                    bins = rows_of(row.get("reliability"))
                    columns = [column_of(bins, name) for name in ("predicted", "seen", "size")]
                    if bins:
                        yield Reliability(artifact.task, artifact.seed, episodes, int(step), *columns)


def _round(artifact: Trained) -> str:
    return f", round {artifact.round}" if artifact.round > 1 else ""
