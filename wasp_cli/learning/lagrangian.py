"""The adaptive multiplier of a Lagrangian PPO: its rules, and the stable-baselines3 callback that
applies them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from wasp_cli.learning.vec_env import TaskVecEnv


class Rule(Protocol):
    """How a multiplier follows what the latest rollouts measured."""

    follows: str  # column of the learning curve

    @property
    def initial(self) -> float:
        """The multiplier at the beginning."""
        ...

    @property
    def delay(self) -> int:
        """Interactions before it moves."""
        ...

    def next(self, value: float, measured: float, at: int = 0) -> float:
        """Return the multiplier that follows `value` after `at` interactions."""
        ...


@dataclass(frozen=True)
class LaterLimit:
    """A cost limit that holds for the rest of a training."""

    begin: int  # interactions after which it holds
    limit: float  # cost per 1000 env steps


@dataclass(frozen=True)
class MultiplierRule:
    """lambda <- clip(lambda + rate * min(cost / limit - 1, most_excess), floor, bound), once per
    rollout, from `delay` interactions on.
    """

    follows = "cost_per_1000"
    initial: float
    rate: float
    bound: float
    limit: float  # cost per 1000 env steps
    delay: int = 0
    floor: float = 0.0
    later: LaterLimit | None = None  # another limit for the rest of the training
    most_excess: float = math.inf
    """Bound of cost / limit - 1. Below the limit the multiplier falls by `rate` at most. Where an
    untrained policy costs ten times the limit, it would rise nine times as fast, reach its bound
    before the policy has learned anything, and stay there: the policy would learn to stand still.
    """

    def next(self, value: float, cost: float, at: int = 0) -> float:
        """Return the multiplier that follows `value`.

        Args:
            value: the multiplier.
            cost: of the latest rollouts, per 1000 env steps.
            at: interactions so far.
        """
        limit = self.limit
        if self.later is not None and at >= self.later.begin:
            limit = self.later.limit
        excess = min(cost / max(limit, 1e-9) - 1.0, self.most_excess)
        return min(self.bound, max(self.floor, value + self.rate * excess))


@dataclass(frozen=True)
class ReturnRule:
    """lambda <- clip(lambda + rate * (1 - return / least), 0, bound): the multiplier of a
    constraint `return >= least` per episode.
    """

    follows = "return"
    initial: float
    rate: float
    bound: float
    least: float
    delay: int = 0

    def __post_init__(self) -> None:
        if self.least <= 0:
            raise ValueError(f"the least return is {self.least:g}; it has to be positive")

    def next(self, value: float, measured: float, at: int = 0) -> float:
        """Return the multiplier that follows `value`, where the latest episodes returned
        `measured`; `at` does not matter.
        """
        return min(self.bound, max(0.0, value + self.rate * (1.0 - measured / self.least)))


class LagrangianCallback(BaseCallback):
    """Moves the multiplier, keeps exploration above a floor, records the learning curve and stores
    checkpoints.

    The multiplier follows the mean over the latest rollouts that together are as long as an
    episode. A single rollout is too noisy, and where the rows are in phase, it is only a part of
    the episode.

    Args:
        env: its multiplier moves.
        rule: how it moves.
        total: interactions of the whole training.
        progress: called after every rollout with the share that is done and a text.
        log_std_floor: lower bound of the logarithm of the exploration noise.
        checkpoints: functions by the number of interactions at which each is called, once.
        before_rollout: called between two rollouts, when the policy has learned from the last one.
    """

    def __init__(
        self,
        env: TaskVecEnv,
        rule: Rule,
        total: int,
        progress: Callable[[float, str], None],
        *,
        log_std_floor: float | None = None,
        checkpoints: Mapping[int, Callable[[], None]] | None = None,
        before_rollout: Callable[[], None] | None = None,
    ) -> None:
        super().__init__()
        self.total = total
        self._tasks = env
        self._rule = rule
        self._progress = progress
        self._floor = log_std_floor
        self._checkpoints = dict(checkpoints or {})
        self._before_rollout = before_rollout
        self.curve: list[dict[str, float]] = []
        env.multiplier = rule.initial

    def go_on(self, curve: list[dict[str, float]]) -> None:
        """Go on with the learning curve of an interrupted training, whose model and environment
        have been restored. Checkpoints up to its end are not stored again.
        """
        self.curve = list(curve)
        if not curve:
            return
        interactions = curve[-1]["interactions"]
        self._checkpoints = {
            at: store for at, store in self._checkpoints.items() if at > interactions
        }

    def _on_step(self) -> bool:
        due = [at for at in self._checkpoints if self.num_timesteps >= at]
        for at in due:
            store = self._checkpoints.pop(at)
            store()
        return True

    def _on_rollout_start(self) -> None:
        if self._floor is not None:
            log_std: Any = self.model.policy.log_std
            with torch.no_grad():
                log_std.clamp_(min=self._floor)
        if self._before_rollout is not None and self.curve:
            self._before_rollout()

    def _on_rollout_end(self) -> None:
        # -- the learning curve
        row = self._tasks.curve.take()
        row["interactions"] = float(self.num_timesteps)
        row["multiplier"] = self._tasks.multiplier
        self.curve.append(row)

        # -- the unit of rewards and the multiplier of the next rollout
        self._tasks.settle_unit()
        measured = self._average()
        if self.num_timesteps >= self._rule.delay and not math.isnan(measured):
            self._tasks.multiplier = self._rule.next(
                self._tasks.multiplier, measured, self.num_timesteps
            )

        text = (
            f"return {row['return']:.1f}, cost {row['cost']:.1f}, multiplier "
            f"{row['multiplier']:.2f}"
        )
        self._progress(min(1.0, self.num_timesteps / self.total), text)

    def _average(self) -> float:
        """Return the mean of what the rule follows, over rollouts as long as an episode; NaN where
        no episode ended. All rollouts are equally long.
        """
        model: Any = self.model
        rollouts = math.ceil(self._tasks.task.max_decisions / model.n_steps)
        values = [row[self._rule.follows] for row in self.curve[-rollouts:]]
        finite = [value for value in values if not math.isnan(value)]
        return float(np.mean(finite)) if finite else math.nan
