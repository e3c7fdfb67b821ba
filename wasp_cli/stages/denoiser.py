"""Diffusion's denoiser of expert actions.

Artifact: `denoiser.safetensors` (+ .json with the noise schedule).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs import DenoiserConfig
from wasp_cli.stages.base import Job


class DenoiserStage:
    """See the module."""

    kind = "denoiser"
    config = DenoiserConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert", "dataset", "world_model")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the expert's own actions at the states of its careful episodes."""
        import torch

        from wasp_cli.learning.denoiser import train_denoiser
        from wasp_cli.learning.expert import load_skill
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.replay import read_replay
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(DenoiserConfig, job.config)
        replay = read_replay(job.inputs["dataset"], ["privileged", "cost_env", "first", "episode", "behaviour"])
        with torch.inference_mode():
            labels = load_skill(job.inputs["expert"], 1.0)(torch.from_numpy(replay.privileged))
        latents = load_latents(job.inputs["world_model"])
        torch.manual_seed(derive("denoiser-weights", job.task, job.seed))
        denoiser, schedule, summary = train_denoiser(
            replay, labels.clone(), latents, config, derive("denoiser", job.task, job.seed), job.progress
        )
        features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
        save_weights(
            denoiser, job.out_dir / "denoiser.safetensors", features=features, action=labels.shape[1], hidden=list(config.hidden),
            steps=schedule.steps, schedule={"steps": config.steps, "beta_min": config.beta_min, "beta_max": config.beta_max},
        )  # fmt: skip
        return summary
