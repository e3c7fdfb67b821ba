"""IDA's Q ensemble: TD on real and noisy transitions for the expert policy.

Artifact: `ensemble.safetensors` (+ .json).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs import EnsembleConfig
from wasp_cli.stages.base import Job


class IDAQStage:
    """See the module."""

    kind = "ida_q"
    config = EnsembleConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the dataset's latents; say how far Q tells the expert's action from a random one."""
        import torch

        from wasp_cli.learning.ensemble import train_ensemble
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.policies import load_skills
        from wasp_cli.learning.replay import read_replay
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(EnsembleConfig, job.config)
        replay = read_replay(job.inputs["dataset"], ["action", "reward", "terminal", "first", "episode", "behaviour"])
        latents = load_latents(job.inputs["world_model"])
        skills = load_skills(job.inputs["policies"])
        torch.manual_seed(derive("ida-weights", job.task, job.seed))
        seed = derive("ida", job.task, job.seed)
        ensemble, summary = train_ensemble(skills, replay, latents, config, job.settings["returns"].gamma_r, seed, job.progress)
        features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
        arguments = {"members": config.members, "features": features, "action": replay.action.shape[1], "hidden": list(config.hidden)}
        save_weights(ensemble, job.out_dir / "ensemble.safetensors", **arguments)
        with torch.inference_mode():
            seen = latents.at(torch.arange(0, len(latents.h), max(1, len(latents.h) // 2000))).features
            expert = skills.expert(seen)
            gap = (ensemble(seen, expert) - ensemble(seen, -expert)).mean()
        return {**summary, "expert_over_opposite": float(gap)}
