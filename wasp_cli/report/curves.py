"""The learning and calibration curves that trained artifacts keep, read with care: a results folder may be untrusted.

What has no valid form is no curve.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import WaspError
from wasp_cli.report.trained_table import Trained
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import parse, read_plain

Floats = NDArray[np.float64]

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
    """Return per episode (`return`) and cost per 1000 env steps (`cost_per_1000`) over the decision steps that a stage trained with."""
    found = []
    for artifact in trained:
        if artifact.kind not in DRIVING:
            continue
        file, name = DRIVING[artifact.kind]
        rows = _rows(_read(layout, artifact, file))
        x = _column(rows, "interactions")
        if len(x) > 1 and np.isfinite(x).all():
            numbers = {key: _column(rows, key) for key in ("return", "cost_per_1000")}
            found.append(Curve(artifact.task, artifact.seed, name + _round(artifact), x, numbers))
    return found


def loss_curves(layout: Layout, trained: Iterable[Trained]) -> list[Curve]:
    """Losses of the world model by LOSSES over its updates, each divided by its first value."""
    found = []
    for artifact in trained:
        if artifact.kind != "world_model":
            continue
        curves = _read(layout, artifact, "curves.json")
        if not isinstance(curves, dict):
            continue
        terms = {title: _numbers(curves.get(term)) for term, title in LOSSES.items()}
        terms = {title: values / values[0] for title, values in terms.items() if len(values) > 1 and values[0] > 0}
        for title, values in terms.items():
            x = UPDATES_PER_POINT * np.arange(len(values), dtype=np.float64)
            found.append(Curve(artifact.task, artifact.seed, title + _round(artifact), x, {"loss": values}))
    return found


def reliabilities(layout: Layout, trained: Iterable[Trained]) -> Iterator[Reliability]:
    """Of the cost head along imagined rollouts, at STEPS, where the stage `diagnostics` has judged it; of the last round."""
    judged = [artifact for artifact in trained if artifact.kind == "diagnostics"]
    last = {(artifact.task, artifact.seed): artifact for artifact in sorted(judged, key=lambda artifact: artifact.round)}
    for artifact in last.values():
        document = _read(layout, artifact, "diagnostics.json")
        for episodes in ("held_out", "unseen"):
            part = document.get(episodes) if isinstance(document, dict) else None
            for row in _rows(part.get("steps") if isinstance(part, dict) else None):
                if (step := row.get("k")) in STEPS:
                    bins = _rows(row.get("reliability"))
                    columns = [_column(bins, name) for name in ("predicted", "seen", "size")]
                    if bins:
                        yield Reliability(artifact.task, artifact.seed, episodes, int(step), *columns)


def _round(artifact: Trained) -> str:
    return f", round {artifact.round}" if artifact.round > 1 else ""


def _read(layout: Layout, artifact: Trained, name: str) -> Any:
    """A JSON file of an artifact; None where there is none or it does not read."""
    with suppress(OSError, ValueError, RecursionError, WaspError):
        return parse(read_plain(layout.within(layout.artifact(artifact.kind, artifact.key) / name)))
    return None


def _rows(value: Any) -> list[Mapping[str, Any]]:
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> Floats:
    return _numbers([row.get(name) for row in rows])


def _numbers(values: Any) -> Floats:
    """[n] real numbers; what is none is NaN."""
    if not isinstance(values, list):
        return np.empty(0)
    plain = [float(value) if isinstance(value, int | float) else math.nan for value in values]
    found = np.array(plain, np.float64)
    return np.where(np.isfinite(found), found, np.nan)
