"""A batch of tasks seen through the world model's filter, as a stable-baselines3 vector environment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.closed_loop import Filter
from wasp_cli.learning.vec_env import Array, TaskVecEnv
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.tasks.base import Observation, VectorTask


class FilteredTask(TaskVecEnv):
    """The task as a policy on latents meets it: it sees features (h, z), and its action within the bounds is executed."""

    def __init__(
        self, task: VectorTask, model: SafetyWorldModel, next_seed: Callable[[], int], *, extra: int = 0, bound: float = 1.0
    ) -> None:
        self._filter = Filter(model, task.batch)
        super().__init__(task, model.feature_size + extra, -bound, bound, next_seed)

    @torch.no_grad()
    def observe(self, seen: Observation, rows: NDArray[np.bool_], executed: Array) -> Array:
        return self.features(seen, torch.from_numpy(rows), executed).numpy()

    def features(self, seen: Observation, first: Tensor, executed: Array) -> Tensor:
        """[B, F] after `executed` [B, A]. Where only some rows are `first` [B], the others have been filtered already and stay."""
        if first.any() and not first.all():
            old, new = self._filter.latent, self._filter.see(seen, first.float())
            mask = first.unsqueeze(-1)
            self._filter.latent = type(new)(torch.where(mask, new.h, old.h), torch.where(mask, new.z, old.z))
        else:
            self._filter.executed(torch.from_numpy(np.asarray(executed, np.float32)))
            self._filter.see(seen, first.float())
        return self._filter.latent.features

    def execute(self, action: Array) -> tuple[Array, Array]:
        return action.clip(-1, 1), np.zeros(len(action), np.float32)
