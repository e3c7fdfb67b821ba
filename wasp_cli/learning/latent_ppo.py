"""PPO on latents with stable-baselines3: tasks seen through the world model's filter, and a
warm-up in which only the value function is trained.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor

from wasp_cli.learning.closed_loop import Filter
from wasp_cli.learning.vec_env import Array, TaskVecEnv
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.tasks.base import Observation, VectorTask


class FilteredTask(TaskVecEnv):
    """The task as a policy on latents sees it: observations are features (h, z), and the action
    within the bounds is executed.
    """

    def __init__(
        self,
        task: VectorTask,
        model: SafetyWorldModel,
        next_seed: Callable[[], int],
        *,
        extra: int = 0,
        bound: float = 1.0,
    ) -> None:
        self._filter = Filter(model, task.batch)
        super().__init__(task, model.feature_size + extra, -bound, bound, next_seed)

    @torch.no_grad()
    def observe(self, seen: Observation, rows: NDArray[np.bool_], executed: Array) -> Array:
        """Return the features [B, F], see `TaskVecEnv.observe`."""
        return self.features(seen, torch.from_numpy(rows), executed).numpy()

    def features(self, seen: Observation, first: Tensor, executed: Array) -> Tensor:
        """Return features [B, F] after `executed` [B, A].

        Where only some rows are `first` [B], the others have been filtered already and keep their
        latents.
        """
        if first.any() and not first.all():
            before = self._filter.latent
            after = self._filter.see(seen, first.float())
            mask = first.unsqueeze(-1)
            h = torch.where(mask, after.h, before.h)
            z = torch.where(mask, after.z, before.z)
            self._filter.latent = Latent(h, z)
        else:
            self._filter.executed(torch.from_numpy(np.asarray(executed, np.float32)))
            self._filter.see(seen, first.float())
        return self._filter.latent.features

    def execute(self, action: Array) -> tuple[Array, Array]:
        """Return the action within the bounds, and no penalty."""
        return action.clip(-1, 1), np.zeros(len(action), np.float32)


class ValueWarmup(BaseCallback):
    """Trains only the value function during the first `until` interactions, so that the actor does
    not follow the noise of an untrained one.
    """

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
