"""Seconds of nodes that this machine has not computed yet: measured on another one, and scaled by the speed of this one.

The figures are medians by preset, stage, task and method; those of cells are per episode. `wasp bench times RESULTS` makes them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

from wasp_cli.plan.node import Node

FIGURES = Path(__file__).parent / "times.json"
MEASURE_SECONDS = 0.5
SIZE = 65_536
PER_EPISODE = ("evaluate", "counterfactual")
"""Stages whose time grows with the episodes of a cell."""


def figure_of(kind: str, task: str, method: object) -> str:
    """Return the name of a figure: `evaluate goal1 wasp`."""
    return " ".join(filter(None, (kind, task, str(method) if method else "")))


@cache
def speed() -> float:
    """Return how much one core does, in rounds of arithmetic and Python per second. Without BLAS, whose threads are no part of it."""
    import numpy as np

    values = np.random.default_rng(0).random(SIZE, dtype=np.float32)
    rounds, begun = 0, time.perf_counter()
    while (passed := time.perf_counter() - begun) < MEASURE_SECONDS:
        values = np.tanh(values * np.float32(1.5)) + np.float32(0.1)
        sum(number * number for number in range(2000))
        rounds += 1
    return rounds / passed


def shipped(path: Path = FIGURES) -> Mapping[str, Any]:
    """Return the figures: `speed` of the machine that they were measured on, and `seconds` by preset and name."""
    figures: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return figures


def estimated(nodes: Iterable[Node], preset: str, figures: Mapping[str, Any] | None = None) -> dict[str, float]:
    """Return the seconds by sort that nodes will take here, where there is a figure for them.

    Args:
        nodes: any.
        preset: of their spec. Sizes that a spec changes are not known.
        figures: as `shipped` gives them.
    """
    figures = shipped() if figures is None else figures
    known: Mapping[str, float] = figures["seconds"].get(preset, {})
    found: dict[str, float] = {}
    for node in nodes:
        seconds = known.get(figure_of(node.kind, node.task, node.axes.get("method")))
        if seconds is not None:
            found[node.sort] = seconds * _episodes(node.kind, node.config)
    scale = figures["speed"] / speed() if found else 1.0
    return {sort: seconds * scale for sort, seconds in found.items()}


def figures_of(manifests: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the figures of what was computed on this machine.

    Args:
        manifests: each with the preset of its spec.
    """
    times: dict[str, dict[str, list[float]]] = {}
    for preset, manifest in manifests:
        name = figure_of(manifest["kind"], manifest["task"], manifest["axes"].get("method"))
        seconds = float(manifest["provenance"]["seconds"]) / _episodes(manifest["kind"], manifest["config"])
        times.setdefault(preset, {}).setdefault(name, []).append(seconds)
    seconds_of = {preset: {name: round(median(values), 3) for name, values in sorted(found.items())} for preset, found in times.items()}
    return {"speed": round(speed(), 1), "seconds": seconds_of}


def _episodes(kind: str, config: Mapping[str, Any]) -> int:
    return int(config.get("episodes", 1)) if kind in PER_EPISODE else 1
