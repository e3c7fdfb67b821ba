"""Diffusion's denoiser of expert actions.

Artifact: `denoiser.safetensors` (+ .json with the noise schedule), `quality.json` (on held-out episodes: how near the denoised
commands are to the expert's actions and to the commands, see `learning.denoiser`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.baselines import DenoiserConfig
from wasp_cli.stages.base import Job

QUALITY_ROWS = 4000
"""Held-out decisions at which the denoiser is judged."""


class DenoiserStage:
    """See the module."""

    kind = "denoiser"
    config = DenoiserConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert", "dataset", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the expert's own actions at recorded states, and judge it on held-out ones."""
        import numpy as np
        import torch

        from wasp_cli.learning.denoiser import denoiser_quality, noise_loss, train_denoiser
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.sampling import generator
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.policy import load_privileged
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(DenoiserConfig, job.config)
        recording = read_shards(job.inputs["dataset"], ["privileged", "action", "cost_env", "first", "episode", "behaviour"])
        with torch.inference_mode():
            labels = load_privileged(job.inputs["expert"], 1.0)(torch.from_numpy(recording.privileged))
        latents = load_latents(job.inputs["latents"])
        torch.manual_seed(derive("denoiser-weights", job.task, job.seed))
        denoiser, schedule, summary = train_denoiser(
            recording, labels.clone(), latents, config, job.settings["action_repeat"], derive("denoiser", job.task, job.seed), job.progress
        )
        features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
        save_weights(
            denoiser, job.out_dir / "denoiser.safetensors", features=features, action=labels.shape[1], hidden=list(config.hidden),
            steps=schedule.steps, schedule={"steps": config.steps, "beta_min": config.beta_min, "beta_max": config.beta_max},
        )  # fmt: skip
        # The action at row i + 1 is what was executed at the state of row i.
        held = torch.from_numpy(np.flatnonzero(recording.held_out(HELD_OUT)[:-1] & ~recording.first[1:].astype(bool)))
        held = held[:: max(1, len(held) // QUALITY_ROWS)]
        seen, source = latents.at(held).features, generator(derive("denoiser-quality", job.task, job.seed))
        summary["heldout_noise_loss"] = noise_loss(denoiser, schedule, seen, labels[held], source)
        recorded = torch.from_numpy(recording.action)[held + 1]
        quality = denoiser_quality(denoiser, schedule, seen, labels[held], recorded, source)
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))
        asked, given = (quality["recorded"][ratio]["conformity"] for ratio in ("0", "0.4"))
        return summary | {"off_expert": round(asked, 3), "off_expert_denoised": round(given, 3)}
