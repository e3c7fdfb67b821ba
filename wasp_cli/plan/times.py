"""Seconds of nodes that this machine has not computed yet: measured on another one, and scaled by the speed of this one.

The figures are medians by preset, stage, task and method, for stages in `SIZES` per unit of their size.
`python -m tests.benchmarks.times RESULTS` makes them. A variant that nobody measured is taken for its method, and a method that nobody
measured for WASP, the slowest.
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
SLICES, SLICE_SECONDS = 25, 0.01
SIZE = 65_536
SIZES = {
    "expert": "interactions", "dataset": "steps", "world_model": "updates", "residual": "interactions",
    "evaluate": "episodes",
}  # fmt: skip
"""By stage the setting that its time grows with."""
SLOWEST = "wasp"
"""The method that stands for one that nobody measured."""


def figure_of(kind: str, task: str, axes: Mapping[str, Any]) -> str:
    """Return the name of a figure: `evaluate goal1 wasp/no-case2`."""
    return figures_like(kind, task, axes)[0]


def figures_like(kind: str, task: str, axes: Mapping[str, Any]) -> list[str]:
    """Return the name of a figure, and behind it those that stand for it where it is not there, nearest first."""
    method, config = axes.get("method"), axes.get("method_config")
    if not method:
        return [f"{kind} {task}"]
    variant = config.get("variant", "full") if isinstance(config, Mapping) else "full"
    own = [f"{method}/{variant}"] if variant != "full" else []
    return [f"{kind} {task} {assistant}" for assistant in dict.fromkeys((*own, method, SLOWEST))]


@cache
def speed() -> float:
    """Return how much one core does, in rounds of arithmetic and Python per second. Without BLAS, whose threads are no part of it."""
    import numpy as np

    values = np.random.default_rng(0).random(SIZE, dtype=np.float32)

    def rounds_per_second() -> float:
        rounds, begun, until = 0, time.thread_time(), time.perf_counter() + SLICE_SECONDS
        while time.perf_counter() < until or not rounds:
            np.tanh(values * np.float32(1.5)) + np.float32(0.1)
            sum(number * number for number in range(2000))
            rounds += 1
        return rounds / max(time.thread_time() - begun, 1e-9)

    return max(rounds_per_second() for _ in range(SLICES))  # the fastest: others may use the machine too


def shipped(path: Path = FIGURES) -> Mapping[str, Any]:
    """Return the figures: `speed` of the machine that they were measured on, and `seconds` by preset and name."""
    figures: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return figures


def estimated(nodes: Iterable[Node], preset: str, near: Iterable[tuple[Node, float]] = ()) -> dict[str, float]:
    """Return the seconds by sort that nodes will take here, where there is a figure for them or for something like them.

    `near` are nodes of the same spec that were computed, each with its seconds.
    """
    figures = shipped()
    known: Mapping[str, float] = figures["seconds"].get(preset, {})
    times: dict[str, list[float]] = {}
    for node, seconds in near:
        times.setdefault(figure_of(node.kind, node.task, node.axes), []).append(seconds / units(node.kind, node.config))
    elsewhere: dict[str, float] = {}
    found: dict[str, float] = {}
    for node in nodes:
        size = units(node.kind, node.config)
        for name in figures_like(node.kind, node.task, node.axes):
            if name in times:
                found[node.sort] = median(times[name]) * size
            elif name in known:
                elsewhere[node.sort] = known[name] * size
            else:
                continue
            break
    scale = figures["speed"] / speed() if elsewhere else 1.0
    return found | {sort: seconds * scale for sort, seconds in elsewhere.items()}


def units(kind: str, config: Mapping[str, Any]) -> int:
    """Return how many times a figure a node of this size takes."""
    return int(config.get(SIZES.get(kind, ""), 1))
