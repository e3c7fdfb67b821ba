"""Oracle dynamics: the same planner on the true simulator, which separates errors of the world model from those of the planner.

Worlds and the operator's mistakes are those of the evaluation of the same cell, and the same for every assistant. Operator and
imagination read the privileged observation; the planner sees nothing beyond its horizon.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from wasp_cli import seeds
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.memory import keep_memory
from wasp_cli.methods.base import Assistant
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.wasp.assistant import WASP, effective
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.metrics.episode import WEIGHTS, EpisodeMetrics, episode_metrics, pool
from wasp_cli.models.policy import load_privileged
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, Policy, build_operator
from wasp_cli.studies.simulator import NoCritics, SimulatorModel, on_features
from wasp_cli.tasks.base import VectorTask
from wasp_cli.tasks.make import make_task

SIDE_BY_SIDE = 8
"""Episodes in a batch: with 64 candidates each, larger batches of the simulator are no faster."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Cell:
    """The operator to assist, the task, and the episodes."""

    task: str
    seed: int
    variant: str
    """of the operator"""
    value: float
    """its severity"""
    episodes: int
    action_repeat: int
    gamma_r: float
    gamma_c: float
    success_goals: int
    safe_cost: float
    expert: Path
    """folder of the privileged checkpoints"""


@dataclass(frozen=True)
class Outcome:
    """What an assistant reached."""

    variant: str | None
    """of WASP; None: nobody assists"""
    rows: tuple[EpisodeMetrics, ...]
    """one per episode"""
    seconds: float
    """wall time of all episodes"""

    def pooled(self) -> dict[str, float | None]:
        """Return the numbers of the cell: rates are ratios of sums; undefined ones are None."""
        numbers = {name: float(values[0]) for name, values in pool(self._columns()).items()}
        return {name: value if np.isfinite(value) else None for name, value in numbers.items()}

    def column(self, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return one of `WEIGHTS` or their weights by episode [E]; NaN where it is undefined."""
        attribute = "return_" if name == "return" else name
        return np.array([getattr(row, attribute) for row in self.rows], np.float64)

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        rows = [{field.name.rstrip("_"): getattr(row, field.name) for field in fields(row)} for row in self.rows]
        return {"method": "human" if self.variant is None else "wasp", "variant": self.variant, "seconds": self.seconds,
                **self.pooled(), "episodes": rows}  # fmt: skip

    def _columns(self) -> Mapping[str, np.ndarray[Any, np.dtype[np.float64]]]:
        weights = {name for name in WEIGHTS.values() if name is not None} | {"decisions"}
        return {name: self.column(name) for name in {*WEIGHTS, *weights}}


def assisted(cell: Cell, config: WASPConfig | None, threads: int, progress: Progress) -> Outcome:
    """Run all episodes of a cell under WASP with a perfect model, or without assistance.

    Args:
        cell: what to run.
        config: of the planner; None: nobody assists.
        threads: of the simulators; results do not depend on it.
        progress: told the share that is done.

    Raises:
        TaskError: the task has no snapshots.
        ArtifactError: a checkpoint is damaged.
    """
    begun = time.perf_counter()
    keep_memory()
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # the policies are small
    rows: list[EpisodeMetrics] = []
    try:
        for first in range(0, cell.episodes, SIDE_BY_SIDE):
            episodes = range(first, min(first + SIDE_BY_SIDE, cell.episodes))

            def tell(share: float, text: str, episodes: range = episodes) -> None:
                progress(
                    (episodes.start + share * len(episodes)) / cell.episodes, f"episodes {episodes.start + 1} to {episodes.stop}: {text}"
                )

            rows += _batch(cell, config, episodes, threads, tell)
    finally:
        torch.set_num_threads(before)
    return Outcome(None if config is None else config.variant, tuple(rows), time.perf_counter() - begun)


def _batch(cell: Cell, config: WASPConfig | None, episodes: range, threads: int, progress: Progress) -> list[EpisodeMetrics]:
    batch = len(episodes)

    def build(rows: int, observe: str = "privileged") -> VectorTask:
        return make_task(cell.task, rows, action_repeat=cell.action_repeat, observe=(observe,), threads=threads)

    # The loop hands images to the filter. This one needs none; drawing them takes a hundredth of the time.
    task = build(batch, "pixels")
    model = SimulatorModel(task, build)
    mistakes = EpisodeNoise([seeds.operator_seed(cell.task, cell.variant, cell.value, cell.seed, e) for e in episodes])
    context = OperatorContext(lambda fraction: _skill(cell.expert, fraction), task.action_size, task.decision_seconds)
    operator = build_operator(cell.variant, cell.value, context, mistakes, batch)
    layouts = [seeds.layout_seed(cell.task, cell.seed, e) for e in episodes]
    own = [seeds.method_seed(cell.task, cell.variant, cell.value, cell.seed, e, "wasp") for e in episodes]
    loop = run_episodes(task, cast(SafetyWorldModel, model), operator, _assistant(cell, config, model), layouts, own, progress=progress)
    return [episode_metrics(trajectory, cell.success_goals, cell.safe_cost) for trajectory in trajectories(loop)[0]]


def _assistant(cell: Cell, config: WASPConfig | None, model: SimulatorModel) -> Assistant:
    if config is None:
        return HumanOnly()
    # lambda = 1: with no critics to mix in, a smaller one would only discount once more.
    return WASP(config, Imagination(model, NoCritics(), effective(config), cell.gamma_r, cell.gamma_c, lam=1.0), {})


def _skill(folder: Path, fraction: float) -> Policy:
    return on_features(load_privileged(folder, fraction).requires_grad_(False))
