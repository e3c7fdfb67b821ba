"""The unit in which rewards are learned from.

Weights of losses, Lagrange multipliers and the price of a correction are settings in the unit of a
reward. A lander's reward of -100 and a point's reward of .1 cannot share them. So every training
divides rewards by a unit of its task. Rows, tables and predictions stay as the task says them.

The tasks of this package are the ones on which the settings were chosen: their unit is 1.
Elsewhere it is twice the standard deviation of a decision's reward, since on those tasks the
standard deviation is about half (.67 on Race1, with every behaviour of its dataset).
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
    """Return whether the unit of a task is measured: it is none of this package."""
    return name not in TASKS.own


def most_excess(name: str) -> float:
    """Return the bound of a relative excess cost in a multiplier's rule: on a task whose limit
    follows from random commands, a multiplier rises no faster than it sinks.
    """
    return 1.0 if is_measured(name) else math.inf


def unit_of(name: str, rewards: NDArray[np.floating]) -> float:
    """Return the unit of a task from rewards [N] of its decisions; 1 for a task of this package,
    and where all rewards are the same.
    """
    if not is_measured(name) or not len(rewards):
        return 1.0
    unit = DEVIATIONS * float(np.std(rewards, dtype=np.float64))
    return unit if unit > 0.0 else 1.0


def first_unit(task: VectorTask, name: str, seed: int) -> float:
    """Return the unit of a task of which nothing is recorded yet: from the beginnings of episodes
    under random commands, in which its rows are left.

    Args:
        task: B episodes; the caller resets them.
        name: of the task.
        seed: of the training.
    """
    if not is_measured(name):
        return 1.0
    task.reset([derive("reward-unit-episode", name, seed, row) for row in range(task.batch)])
    draws = np.random.default_rng(derive("reward-unit-commands", name, seed))
    found = []
    ended = np.zeros(task.batch, np.bool_)
    for _ in range(min(LOOK, task.max_decisions)):
        step = task.step(draws.uniform(-1.0, 1.0, (task.batch, task.action_size)))
        found.append(step.reward[~ended])
        ended = step.ended
        if ended.all():
            break
    return unit_of(name, np.concatenate(found))


class GrowingUnit:
    """The unit of a training that meets more of its task as it goes on: the largest that one of its
    rollouts has. It grows only, so that a policy that has learned to keep still is not asked to.
    """

    def __init__(self, name: str, first: float) -> None:
        self._name = name
        self.value = first
        self._rewards: list[NDArray[np.floating]] = []

    def see(self, rewards: NDArray[np.floating]) -> None:
        """Take rewards [B] of a decision step."""
        if is_measured(self._name):
            self._rewards.append(rewards.copy())

    def settle(self) -> None:
        """Take what was seen since the last call into account; called between two rollouts."""
        if self._rewards:
            found = unit_of(self._name, np.concatenate(self._rewards))
            self.value = max(self.value, found)
            self._rewards.clear()
