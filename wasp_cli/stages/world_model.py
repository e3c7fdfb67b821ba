"""World model: Eq. 6 on sequences, refit of the heads on prior latents, latents of the whole dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.base import Job
from wasp_cli.stages.configs import WorldModelConfig


class WorldModelStage:
    """World model: Eq. 6 on sequences, refit of the heads on prior latents, latents of the whole dataset."""

    kind = "world_model"
    config = WorldModelConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("dataset",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """See the module named below; it documents the artifact's files."""
        from wasp_cli.learning.world_model import train_world_model

        return train_world_model(job)
