"""The Q-CBF filter's critic and fallback actor. Artifact: `safety.safetensors` and
`actor.safetensors` (+ .json each), `curve.json`, `quality.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.fallback import FallbackConfig
from wasp_cli.stages.base import Job


class FallbackStage:
    """See the module."""

    kind = "fallback"
    config = FallbackConfig
    settings: tuple[str, ...] = ()
    needs: tuple[str, ...] = ("dataset", "world_model", "latents", "policies", "heldout")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train both, then compare the values of what was executed with the costs that followed."""
        import torch

        from wasp_cli.learning.fallback import fallback_quality, train_fallback
        from wasp_cli.learning.foresight import safety_quality
        from wasp_cli.learning.heldout import load_heldout
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import read_shards
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive

        config = cast(FallbackConfig, job.config)
        model = load_world_model(job.inputs["world_model"])
        latents = load_latents(job.inputs["latents"])
        skills = load_skills(job.inputs["policies"])
        recording = read_shards(
            job.inputs["dataset"], ["action", "cost", "terminal", "first", "episode"]
        )
        torch.manual_seed(derive("fallback-weights", job.task, job.seed))
        stream = derive("fallback", job.task, job.seed)
        value, actor, curve = train_fallback(
            model, skills, recording, latents, config, stream, job.progress
        )
        sizes = {"features": model.feature_size, "action": model.action_size}
        save_weights(
            rounded(value),
            job.out_dir / "safety.safetensors",
            **sizes,
            hidden=config.hidden,
            action_scales=list(model.sizes.action_scales),
            members=len(value.members),
        )
        save_weights(
            rounded(actor),
            job.out_dir / "actor.safetensors",
            **sizes,
            hidden=[config.hidden, config.hidden],
        )
        (job.out_dir / "curve.json").write_text(json.dumps(curve, indent=1))
        heldout = load_heldout(job.inputs["heldout"])
        of_critic = safety_quality(value, recording, latents, heldout)
        of_actor = fallback_quality(value, actor, heldout.latent.features)
        quality = {**of_critic, "fallback": of_actor}
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))

        # -- summary
        numbers = {f"auc_{name}": part["auc"] for name, part in of_critic.items()}
        numbers["at_least_as_safe"] = of_actor["at_least_as_safe"]
        summary: dict[str, float | None] = {
            "loss": round(curve[-1]["loss"], 4),
            "danger": round(curve[-1]["danger"], 4),
        }
        for name, number in numbers.items():
            summary[name] = None if number is None else round(number, 3)
        return summary
