"""The unit of rewards in training.

Weights of losses, Lagrange multipliers and the price of a correction are settings in the unit of a
reward. A lander's reward of -100 and a point's reward of .1 cannot share them, so every training
divides rewards by a unit of its task. Rows, tables and predictions keep the rewards of the task.

The settings were chosen on the tasks of this package: their unit is 1. On other tasks the unit is
twice the standard deviation of a decision's reward, because on the tasks of this package the
standard deviation is about one half (.67 on Race1, over all behaviours of its dataset).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask
from wasp_cli.tasks.registry import TASKS

DEVIATIONS = 2.0
"""Standard deviations of a decision's reward that make a unit."""
LOOK = 64
"""Decisions of random commands from which a training takes its first unit."""


def is_measured(name: str) -> bool:
    """Return whether the unit of a task is measured: whether the task is not of this package."""
    return name not in TASKS.own


def most_excess(name: str) -> float:
    """Return the bound of the relative excess cost in a multiplier's rule (see `MultiplierRule`).

    On a task that is not of this package the limit follows from random commands, and the multiplier
    rises no faster than it falls.
    """
    return 1.0 if is_measured(name) else math.inf


def unit_of(name: str, rewards: NDArray[np.floating]) -> float:
    """Return the unit of a task from rewards [N] of its decisions. It is 1 for a task of this
    package, and where all rewards are the same.
    """
    if not is_measured(name) or not len(rewards):
        return 1.0
    unit = DEVIATIONS * float(np.std(rewards, dtype=np.float64))
    return unit if unit > 0.0 else 1.0


def first_unit(task: VectorTask, name: str, seed: int) -> float:
    """Return the unit of a task of which nothing is recorded yet: from the beginnings of episodes
    under random commands.

    Args:
        task: B episodes; they are left where they are, and the caller resets them.
        name: of the task.
        seed: of the training chain.
    """
    if not is_measured(name):
        return 1.0
    task.reset([derive("reward-unit-episode", name, seed, row) for row in range(task.batch)])
    draws = np.random.default_rng(derive("reward-unit-commands", name, seed))
    rewards = []
    ended = np.zeros(task.batch, np.bool_)
    for _ in range(min(LOOK, task.max_decisions)):
        step = task.step(draws.uniform(-1.0, 1.0, (task.batch, task.action_size)))
        rewards.append(step.reward[~ended])
        ended = step.ended
        if ended.all():
            break
    return unit_of(name, np.concatenate(rewards))


class GrowingUnit:
    """The unit of a training that sees more of its task as it goes on: the largest unit of any
    rollout so far. It never shrinks, so that it does not follow the small rewards of a policy that
    has learned to stand still.
    """

    def __init__(self, name: str, first: float) -> None:
        self._name = name
        self.value = first
        self._rewards: list[NDArray[np.floating]] = []

    def see(self, rewards: NDArray[np.floating]) -> None:
        """Add the rewards [B] of a decision."""
        if is_measured(self._name):
            self._rewards.append(rewards.copy())

    def settle(self) -> None:
        """Let the unit follow the rewards since the last call; called between two rollouts."""
        if not self._rewards:
            return
        self.value = max(self.value, unit_of(self._name, np.concatenate(self._rewards)))
        self._rewards.clear()
