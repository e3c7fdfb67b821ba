"""Episodes without a camera: of a policy on privileged observations, and of zero and random
commands.
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
    """Sums over whole episodes, [B] each."""

    returns: np.ndarray[Any, Any]
    costs: np.ndarray[Any, Any]  # env steps that cost
    costly: np.ndarray[Any, Any]  # decision steps that cost
    goals: np.ndarray[Any, Any]
    env_steps: np.ndarray[Any, Any]

    def statistics(self, success_goals: int) -> dict[str, float | None]:
        """Return `return`, `cost` and `goals` as means over the episodes, their standard deviations
        (`..._sd`; None for a single episode), `cost_per_1000` env steps, `success`, the share with
        at least `success_goals` goals, and the number of `episodes`.
        """
        numbers: dict[str, float | None] = {}
        for name, values in (("return", self.returns), ("cost", self.costs), ("goals", self.goals)):
            numbers[name] = float(values.mean())
            numbers[f"{name}_sd"] = float(values.std(ddof=1)) if len(values) > 1 else None
        numbers["cost_per_1000"] = float(1000.0 * self.costs.sum() / self.env_steps.sum())
        numbers["success"] = float((self.goals >= success_goals).mean())
        numbers["episodes"] = len(self.goals)
        return numbers


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
    """Run one episode per row under zero commands, or the nearest commands within the bounds."""
    zeros = np.zeros((task.batch, task.action_size), np.float32)
    actions: Floats = np.clip(zeros, task.action_low, task.action_high).astype(np.float32)

    def command(seen: Observation) -> Floats:
        return actions

    return episode_sums(task, command, seeds)


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
    """Run one episode per row.

    Args:
        task: B episodes.
        command: from an observation to actions [B, A].
        seeds: [B] of the worlds.
    """
    observation = task.reset(seeds)
    returns = np.zeros(task.batch)
    costs = np.zeros(task.batch)
    costly = np.zeros(task.batch)
    goals = np.zeros(task.batch)
    env_steps = np.zeros(task.batch)
    for _ in range(task.max_decisions):
        step = task.step(command(observation))
        observation = step.observation
        returns += step.reward
        costs += step.cost_env
        costly += step.cost
        goals += step.goals
        env_steps += step.env_steps
        if step.ended.all():
            break
    return EpisodeSums(returns, costs, costly, goals, env_steps)
