"""The reachability filter's safety value. Artifact: `safety.safetensors` (+ .json),
`curve.json`, `quality.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.reachability import ReachabilityConfig
from wasp_cli.stages.base import Job


class ReachabilityStage:
    """See the module."""

    kind = "reachability"
    config = ReachabilityConfig
    settings: tuple[str, ...] = ()
    needs: tuple[str, ...] = ("dataset", "world_model", "latents", "policies", "heldout")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train, then compare the values of what was executed with the costs that followed."""
        import torch

        from wasp_cli.learning.foresight import safety_quality
        from wasp_cli.learning.heldout import load_heldout
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.reachability import train_safety_value
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import read_shards
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive

        config = cast(ReachabilityConfig, job.config)
        model = load_world_model(job.inputs["world_model"])
        latents = load_latents(job.inputs["latents"])
        recording = read_shards(
            job.inputs["dataset"], ["action", "cost", "terminal", "first", "episode"]
        )
        skills = load_skills(job.inputs["policies"])
        torch.manual_seed(derive("reachability-weights", job.task, job.seed))
        stream = derive("reachability", job.task, job.seed)
        value, curve = train_safety_value(
            model, skills, recording, latents, config, stream, job.progress
        )
        save_weights(
            rounded(value),
            job.out_dir / "safety.safetensors",
            features=model.feature_size,
            action=model.action_size,
            hidden=config.hidden,
            action_scales=list(model.sizes.action_scales),
            members=len(value.members),
        )
        (job.out_dir / "curve.json").write_text(json.dumps(curve, indent=1))
        quality = safety_quality(value, recording, latents, load_heldout(job.inputs["heldout"]))
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))
        summary: dict[str, float | None] = {
            "loss": round(curve[-1]["loss"], 4),
            "danger": round(curve[-1]["danger"], 4),
        }
        for name, numbers in quality.items():
            auc = numbers["auc"]
            summary[f"auc_{name}"] = None if auc is None else round(auc, 3)
        return summary
