"""Latents of every recorded row, in an artifact of their own because evaluations do not read them.
Artifact: `latents.safetensors` (h float16, z).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.learning.configs.world import LatentsConfig
from wasp_cli.stages.base import Job


class LatentsStage:
    """See the module."""

    kind = "latents"
    config = LatentsConfig
    settings: tuple[str, ...] = ()
    needs: tuple[str, ...] = ("dataset", "world_model")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Filter every recorded episode and store the latents."""
        from wasp_cli.learning.device import training_device
        from wasp_cli.learning.encoding import encode
        from wasp_cli.learning.latents import save_latents
        from wasp_cli.learning.shards import read_shards
        from wasp_cli.models.world_model import load_world_model

        model = load_world_model(job.inputs["world_model"]).to(training_device())
        columns = [model.reads, "action", "first", "episode"]
        recording = read_shards(job.inputs["dataset"], columns)
        latents = encode(model, recording, job.progress)
        save_latents(latents, job.out_dir)
        size = (job.out_dir / "latents.safetensors").stat().st_size
        return {"rows": len(latents.h), "megabytes": round(size / 2**20, 1)}
