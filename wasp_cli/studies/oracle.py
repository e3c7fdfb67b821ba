"""Oracle dynamics: the same planner on the true simulator, which separates errors of the world model from those of the planner.

Worlds and the operator's mistakes are those of the evaluation of the same cell, and the same for every assistant. Operator and
imagination read the privileged observation; the planner sees nothing beyond its horizon.

The true task stands in for the world model: imagination by snapshot and restore. What is imagined is what would happen, so that a planner
on it shows what it reaches when nothing is wrong with the model. It foresees the rest of the task's randomness too (where the next goal
will appear), but not the operator's, whose imagined draws are the planner's own.

B = episodes of the task, R = imagined rows, A = action size, P = size of the privileged observation. A latent has
h = [stamp, row, step, reward, cost, goes on, privileged observation] (D = 6 + P) and no z.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli import seeds
from wasp_cli.errors import TaskError
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.memory import keep_memory
from wasp_cli.methods.base import Assistant
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.metrics.episode import WEIGHTS, EpisodeMetrics, episode_metrics, pool
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import load_privileged
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, Policy, build_operator
from wasp_cli.tasks.base import Bools, Observation, VectorTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

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
    mistakes = EpisodeNoise([seeds.operator_seed(cell.task, cell.variant, cell.seed, e) for e in episodes])
    context = OperatorContext(lambda fraction: _skill(cell.expert, fraction), task.action_size, task.decision_seconds)
    operator = build_operator(cell.variant, cell.value, context, mistakes, batch)
    layouts = [seeds.layout_seed(cell.task, cell.seed, e) for e in episodes]
    own = [seeds.method_seed(cell.task, cell.variant, cell.seed, e, "wasp") for e in episodes]
    loop = run_episodes(task, cast(SafetyWorldModel, model), operator, _assistant(cell, config, model), layouts, own, progress=progress)
    force = TASKS[cell.task].motors.force
    return [episode_metrics(trajectory, cell.success_goals, cell.safe_cost, force) for trajectory in trajectories(loop)[0]]


def _assistant(cell: Cell, config: WASPConfig | None, model: SimulatorModel) -> Assistant:
    if config is None:
        return HumanOnly()
    # lambda = 1: with no critics to mix in, a smaller one would only discount once more.
    imagination = Imagination(model, NoCritics(), _skill(cell.expert, 1.0), cell.gamma_r, cell.gamma_c, lam=1.0)
    return WASP(config, imagination, {}, TASKS[cell.task].motors)


def _skill(folder: Path, fraction: float) -> Policy:
    return on_features(load_privileged(folder, fraction).requires_grad_(False))


STAMP, ROW, STEP, REWARD, COST, GOES_ON, SEEN = range(7)
"""Columns of h. The first three say which simulated state it stands for, SEEN is where the privileged observation begins."""

Build = Callable[[int], VectorTask]
"""A task of so many rows, of the same class and options as the real one, that observes `privileged`."""


def on_features(policy: Policy) -> Policy:
    """Wrap a policy on privileged observations [R, P] as one on the features [R, D] of a simulator's latents."""
    return lambda features: policy(features[:, SEEN:])


@dataclass
class _Simulation:
    """R rows of one simulator, and where they are."""

    simulator: VectorTask
    stamp: int
    """names the simulation: no other one has it"""
    seen: NDArray[np.float32]
    """[R, P]"""
    ended: Bools
    """[R]"""
    step: int = 0
    """decision steps since the restored state"""

    def advance(self, action: NDArray[Any]) -> Latent:
        """One decision step under `action` [R, A]; nothing happens in rows whose episodes have ended."""
        self.step += 1
        reward, cost = np.zeros(len(action)), np.zeros(len(action), np.bool_)
        if not self.ended.all():  # else a task refuses to be stepped
            step = self.simulator.step(action)
            reward, cost, self.seen, self.ended = step.reward, step.cost, _privileged(step.observation), step.ended
        return self.latent(reward, cost)

    def latent(self, reward: NDArray[Any] | float = 0.0, cost: NDArray[Any] | float = 0.0) -> Latent:
        """The latent [R, .] of the present state."""
        rows = len(self.seen)
        h = np.empty((rows, SEEN + self.seen.shape[1]), np.float32)
        h[:, STAMP], h[:, ROW], h[:, STEP] = self.stamp, np.arange(rows), self.step
        h[:, REWARD], h[:, COST], h[:, GOES_ON] = reward, cost, ~self.ended
        h[:, SEEN:] = self.seen
        return Latent(torch.from_numpy(h), torch.zeros(rows, 0))

    def stands_for(self, latent: Latent) -> bool:
        """Whether a latent [R, .] is the present state, row by row."""
        here = torch.tensor([self.stamp, self.step], dtype=latent.h.dtype)
        if len(latent.h) != len(self.seen) or not (latent.h[:, [STAMP, STEP]] == here).all():
            return False
        return bool((latent.h[:, ROW] == torch.arange(len(self.seen))).all())


class SimulatorModel:
    """The world-model contract over a running task, which it never moves.

    `filter` takes a snapshot of the task. The first imagined step restores rows of that snapshot, the next ones go on from there: rollouts
    start at the newest snapshot, run one after the other, and what has been imagined has one successor.
    """

    noise_size = 0
    reads = "pixels"  # what is seen is not read: the task itself is

    def __init__(self, task: VectorTask, build: Build) -> None:
        self.action_size = task.action_size
        self._task, self._build = task, build
        self._simulators: dict[int, VectorTask] = {}
        """By rows: one that is larger than a call needs would restore and observe all of its rows."""
        self._snapshot: dict[str, NDArray[Any]] = {}
        self._stamps = 0
        self._now = -1
        """stamp of the snapshot"""
        self._imagined: _Simulation | None = None

    def initial(self, batch: int) -> Latent:
        """Return the latent before anything is known; nothing can be imagined from it."""
        return Latent(torch.zeros(batch, SEEN + self._task.privileged_size), torch.zeros(batch, 0))

    def filter(self, latent: Latent, action: Tensor, pixels: Tensor, first: Tensor) -> Latent:
        """Return the state of the task as it is now [B, .], whatever the arguments say."""
        self._snapshot = self._task.snapshot()
        for name, array in self._snapshot.items():
            if len(array) != self._task.batch:
                raise TaskError(f"the task's snapshots have no rows in '{name}': no episode of them can be imagined several times")
        present = self._restored(np.arange(self._task.batch))
        self._now, self._imagined = present.stamp, None
        return present.latent()

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        """Return the state [R, .] to which `action` [R, A] leads in the real task; of `noise` there is none.

        Raises:
            TaskError: the latent is neither of the newest snapshot, nor what has just been imagined.
        """
        if bool((latent.h[:, STAMP] == self._now).all()):
            self._imagined = self._restored(latent.h[:, ROW].numpy().astype(np.intp))
        elif self._imagined is None or not self._imagined.stands_for(latent):
            raise TaskError(
                "imagined on from a state that the simulator has left", "a rollout is one chain of steps from the newest latent"
            )
        return self._imagined.advance(action.numpy())

    def reward(self, latent: Latent) -> Tensor:
        """Return the reward [...] of the decision step that led there."""
        return latent.h[..., REWARD]

    def cost(self, latent: Latent) -> Tensor:
        """Return 1 where that decision step cost, else 0 [...]."""
        return latent.h[..., COST]

    def continues(self, latent: Latent) -> Tensor:
        """Return 1 where the episode has not ended, else 0 [...]."""
        return latent.h[..., GOES_ON]

    def _restored(self, rows: NDArray[np.intp]) -> _Simulation:
        """A new simulation from `rows` [R] of the snapshot."""
        if len(rows) not in self._simulators:
            self._simulators[len(rows)] = self._build(len(rows))
        simulator = self._simulators[len(rows)]
        seen = _privileged(simulator.restore({name: array[rows] for name, array in self._snapshot.items()}))
        ended = self._snapshot["ended"] if "ended" in self._snapshot else np.zeros(self._task.batch, np.bool_)
        self._stamps += 1
        return _Simulation(simulator, self._stamps, seen, ended[rows])


class NoCritics:
    """Nothing beyond the horizon."""

    def value_r(self, latent: Latent) -> Tensor:
        """Return zeros [...]."""
        return torch.zeros_like(latent.h[..., 0])

    value_c = value_r


def _privileged(observation: Observation) -> NDArray[np.float32]:
    assert observation.privileged is not None
    return observation.privileged
