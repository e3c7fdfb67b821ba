"""The adaptive multiplier of a Lagrangian PPO, as a stable-baselines3 callback."""

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
    def initial(self) -> float: ...

    @property
    def delay(self) -> int: ...

    def next(self, value: float, measured: float, at: int = 0) -> float: ...


@dataclass(frozen=True)
class MultiplierRule:
    """lambda <- clip(lambda + rate * (cost / limit - 1), floor, bound), once per rollout,
    `delay` interactions after the start.
    """

    follows = "cost_per_1000"
    initial: float
    rate: float
    bound: float
    limit: float  # cost per 1000 env steps
    delay: int = 0
    floor: float = 0.0
    later: tuple[int, float] | None = None  # another limit from so many interactions on
    most_excess: float = math.inf
    """Bound of cost / limit - 1. Below its limit a multiplier sinks by at most `rate`. Where an
    untrained policy costs ten times the limit, it would rise nine times as fast, stand at its bound
    before the policy has learned anything, and stay there: a policy then learns to stand still.
    """

    def next(self, value: float, cost: float, at: int = 0) -> float:
        """Return the multiplier after one of `value`, where the latest cost was that per 1000
        env steps, `at` so many interactions.
        """
        limit = self.later[1] if self.later is not None and at >= self.later[0] else self.limit
        excess = min(cost / max(limit, 1e-9) - 1.0, self.most_excess)
        return min(self.bound, max(self.floor, value + self.rate * excess))


@dataclass(frozen=True)
class ReturnRule:
    """lambda <- clip(lambda + rate * (1 - return / least), 0, bound): the multiplier of a least
    return per episode.
    """

    follows = "return"
    initial: float
    rate: float
    bound: float
    least: float
    delay: int = 0

    def __post_init__(self) -> None:
        if self.least <= 0:
            raise ValueError(
                f"the least return is {self.least:g}, and only a positive one can be asked for"
            )

    def next(self, value: float, measured: float, at: int = 0) -> float:
        """Return the multiplier after one of `value`, where the latest episodes returned
        `measured`; whenever that is.
        """
        return min(self.bound, max(0.0, value + self.rate * (1.0 - measured / self.least)))


class LagrangianCallback(BaseCallback):
    """Moves the multiplier, keeps exploration above a floor, records the learning curve and stores
    checkpoints.

    The multiplier follows the mean over the latest rollouts that together are as long as an
    episode. A single one is too noisy, and where the rows are in phase, it is only a part of the
    episode.

    Args:
        env: whose multiplier moves.
        rule: how it moves.
        total: interactions of the whole training.
        log_std_floor: lower bound of the logarithm of the exploration noise.
        checkpoints: called once each, when that many interactions have been made.
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
        self._tasks, self._rule, self.total, self._progress = env, rule, total, progress
        self._floor, self._checkpoints = log_std_floor, dict(checkpoints or {})
        self._before_rollout = before_rollout
        self.curve: list[dict[str, float]] = []
        env.multiplier = rule.initial

    def go_on(self, curve: list[dict[str, float]]) -> None:
        """Continue a training with that curve, whose owners have been restored."""
        self.curve = list(curve)
        if curve:
            self._checkpoints = {
                at: store
                for at, store in self._checkpoints.items()
                if at > curve[-1]["interactions"]
            }

    def _on_step(self) -> bool:
        for at in [a for a in self._checkpoints if self.num_timesteps >= a]:
            self._checkpoints.pop(at)()
        return True

    def _on_rollout_start(self) -> None:
        if self._floor is not None:
            log_std: Any = self.model.policy.log_std
            with torch.no_grad():
                log_std.clamp_(min=self._floor)
        if self._before_rollout is not None and self.curve:
            self._before_rollout()

    def _on_rollout_end(self) -> None:
        row = self._tasks.curve.take()
        row |= {"interactions": float(self.num_timesteps), "multiplier": self._tasks.multiplier}
        self.curve.append(row)
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
        """What the rule follows, over about the length of an episode; NaN where no episode
        ended. All rollouts are equally long.
        """
        model: Any = self.model
        rollouts = math.ceil(self._tasks.task.max_decisions / model.n_steps)
        found = [row[self._rule.follows] for row in self.curve[-rollouts:]]
        known = [value for value in found if not math.isnan(value)]
        return float(np.mean(known)) if known else math.nan
