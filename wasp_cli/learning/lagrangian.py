"""The adaptive multiplier of a Lagrangian PPO, as a stable-baselines3 callback."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback

from wasp_cli.learning.vec_env import TaskVecEnv


@dataclass(frozen=True)
class MultiplierRule:
    """lambda <- clip(lambda + rate * (cost / limit - 1), 0, bound), once per rollout, `delay` interactions after the start."""

    initial: float
    rate: float
    bound: float
    limit: float
    """Cost per 1000 env steps."""
    delay: int = 0

    def next(self, value: float, cost: float) -> float:
        """The multiplier after a rollout of that cost per 1000 env steps."""
        excess = cost / max(self.limit, 1e-9) - 1.0
        return min(self.bound, max(0.0, value + self.rate * excess))


class LagrangianCallback(BaseCallback):
    """Moves the multiplier, keeps exploration above a floor, records the learning curve and stores checkpoints."""

    def __init__(
        self,
        env: TaskVecEnv,
        rule: MultiplierRule,
        total: int,
        progress: Callable[[float, str], None],
        *,
        log_std_floor: float | None = None,
        checkpoints: Mapping[int, Callable[[], None]] | None = None,
    ) -> None:
        super().__init__()
        self._tasks, self._rule, self._total, self._progress = env, rule, total, progress
        self._floor, self._checkpoints = log_std_floor, dict(checkpoints or {})
        self.curve: list[dict[str, float]] = []
        env.multiplier = rule.initial

    def _on_step(self) -> bool:
        for at in [a for a in self._checkpoints if self.num_timesteps >= a]:
            self._checkpoints.pop(at)()
        return True

    def _on_rollout_start(self) -> None:
        if self._floor is not None:
            log_std: Any = self.model.policy.log_std
            with torch.no_grad():
                log_std.clamp_(min=self._floor)

    def _on_rollout_end(self) -> None:
        row = self._tasks.curve.take()
        row |= {"interactions": float(self.num_timesteps), "multiplier": self._tasks.multiplier}
        self.curve.append(row)
        if self.num_timesteps >= self._rule.delay:
            self._tasks.multiplier = self._rule.next(self._tasks.multiplier, row["cost_per_1000"])
        text = f"return {row['return']:.1f}, cost {row['cost']:.1f}, multiplier {row['multiplier']:.2f}"
        self._progress(min(1.0, self.num_timesteps / self._total), text)
