"""A start for the value function alone, as a stable-baselines3 callback."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback


class ValueWarmup(BaseCallback):
    """Trains only the value function during the first interactions, so that the actor does not move on its noise."""

    def __init__(self, until: int) -> None:
        super().__init__()
        self._until = until

    def _on_training_start(self) -> None:
        self._freeze(self._until > 0)

    def _on_rollout_end(self) -> None:
        if self.num_timesteps >= self._until:
            self._freeze(False)

    def _freeze(self, frozen: bool) -> None:
        policy: Any = self.model.policy
        for module in (policy.mlp_extractor.policy_net, policy.action_net):
            module.requires_grad_(not frozen)
        policy.log_std.requires_grad_(not frozen)

    def _on_step(self) -> bool:
        return True
