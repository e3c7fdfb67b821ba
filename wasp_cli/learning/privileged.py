"""Episodes of a policy on privileged observations, and of commands that look at nothing, without a
camera.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.tasks.base import Observation, VectorTask

Floats = NDArray[np.float32]


class EpisodeSums(NamedTuple):
    """Sums of whole episodes, one entry each."""

    returns: np.ndarray[Any, Any]
    costs: np.ndarray[Any, Any]  # env steps that cost
    costly: np.ndarray[Any, Any]  # decision steps that cost
    goals: np.ndarray[Any, Any]
    env_steps: np.ndarray[Any, Any]

    def statistics(self, success_goals: int) -> dict[str, float | None]:
        """Return means and standard deviations over the episodes (undefined for one), and the
        share with at least `success_goals` goals.
        """
        found: dict[str, float | None] = {}
        for name, values in (("return", self.returns), ("cost", self.costs), ("goals", self.goals)):
            found |= {
                name: float(values.mean()),
                f"{name}_sd": float(values.std(ddof=1)) if len(values) > 1 else None,
            }
        return found | {
            "cost_per_1000": float(1000.0 * self.costs.sum() / self.env_steps.sum()),
            "success": float((self.goals >= success_goals).mean()),
            "episodes": len(self.goals),
        }


def evaluate_privileged(
    task: VectorTask, policy: PrivilegedPolicy, seeds: list[int]
) -> EpisodeSums:
    """Run one episode per row under the deterministic policy."""

    def command(seen: Observation) -> Floats:
        assert seen.privileged is not None
        with torch.inference_mode():
            actions: Floats = policy(torch.from_numpy(seen.privileged)).numpy()
        return actions

    return episode_sums(task, command, seeds)


def evaluate_zero(task: VectorTask, seeds: list[int]) -> EpisodeSums:
    """Run one episode per row under zero commands, or the nearest ones within the bounds."""
    rest = np.zeros((task.batch, task.action_size), np.float32)
    rest = np.clip(rest, task.action_low, task.action_high).astype(np.float32)
    return episode_sums(task, lambda seen: rest, seeds)


def evaluate_random(task: VectorTask, seeds: list[int], seed: int) -> EpisodeSums:
    """Run one episode per row under uniformly random commands, drawn from `seed`."""
    random = np.random.default_rng(seed)
    size = task.batch, task.action_size

    def command(seen: Observation) -> Floats:
        return random.uniform(task.action_low, task.action_high, size).astype(np.float32)

    return episode_sums(task, command, seeds)


def episode_sums(
    task: VectorTask, command: Callable[[Observation], Floats], seeds: list[int]
) -> EpisodeSums:
    """Run one episode per row; `command` makes actions [B, A] of an observation."""
    seen = task.reset(seeds)
    sums = EpisodeSums(*(np.zeros(task.batch) for _ in EpisodeSums._fields))
    for _ in range(task.max_decisions):
        step = task.step(command(seen))
        seen = step.observation
        for total, now in zip(
            sums,
            (step.reward, step.cost_env, step.cost, step.goals, step.env_steps),
            strict=True,
        ):
            total += now
        if step.ended.all():
            break
    return sums
