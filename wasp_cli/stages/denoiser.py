"""Diffusion's denoiser. Artifact: `denoiser.safetensors` (+ .json with the schedule),
`quality.json` (`learning.denoiser`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.baselines import DenoiserConfig
from wasp_cli.stages.base import Job


class DenoiserStage:
    """See the module."""

    kind = "denoiser"
    config = DenoiserConfig
    settings: tuple[str, ...] = ()
    needs: tuple[str, ...] = ("expert", "dataset", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the expert's own actions at recorded states, and judge it on held-out ones."""
        import torch

        from wasp_cli.learning.denoiser import denoiser_quality, noise_loss, train_denoiser
        from wasp_cli.learning.labelled import load_labelled
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.sampling import generator
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(DenoiserConfig, job.config)
        states = load_labelled(job.inputs)
        torch.manual_seed(derive("denoiser-weights", job.task, job.seed))
        stream = derive("denoiser", job.task, job.seed)
        denoiser, schedule, summary = train_denoiser(
            states.recording, states.labels, states.latents, config, stream, job.progress
        )
        save_weights(
            rounded(denoiser),
            job.out_dir / "denoiser.safetensors",
            features=states.latents.features,
            action=states.labels.shape[1],
            hidden=list(config.hidden),
            steps=schedule.steps,
            schedule={
                "steps": config.steps,
                "beta_min": config.beta_min,
                "beta_max": config.beta_max,
            },
        )

        # -- quality on held-out decisions
        held_out = states.held_out()
        source = generator(derive("denoiser-quality", job.task, job.seed))
        summary["heldout_noise_loss"] = noise_loss(
            denoiser, schedule, held_out.features, held_out.expert, source
        )
        quality = denoiser_quality(
            denoiser, schedule, held_out.features, held_out.expert, held_out.executed, source
        )
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))
        distances = quality["recorded"]
        return {
            **summary,
            "off_expert": round(distances["0"]["conformity"], 3),
            "off_expert_denoised": round(distances["0.4"]["conformity"], 3),
        }
