"""Critics: V_r and V_c on imagined rollouts of the nominal expert (Eq. 7-8).

Artifact: `critics.safetensors` (+ .json).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs import CriticsConfig
from wasp_cli.stages.base import Job


class CriticsStage:
    """See the module."""

    kind = "critics"
    config = CriticsConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train, then compare the critics' ranking with real discounted sums."""
        import torch

        from wasp_cli.learning.critics import rank_agreement, train_critics
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.policies import load_skills
        from wasp_cli.learning.replay import read_replay
        from wasp_cli.learning.trained import load_world_model
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(CriticsConfig, job.config)
        model = load_world_model(job.inputs["world_model"])
        latents = load_latents(job.inputs["world_model"])
        skills = load_skills(job.inputs["policies"])
        returns = job.settings["returns"]
        torch.manual_seed(derive("critics-weights", job.task, job.seed))
        critics = train_critics(model, skills, latents, config, returns, derive("critics", job.task, job.seed), job.progress)
        save_weights(critics, job.out_dir / "critics.safetensors", features=model.feature_size, hidden=list(config.hidden))
        replay = read_replay(job.inputs["dataset"], ["reward", "cost", "first", "episode", "behaviour"])
        return rank_agreement(critics, replay, latents, returns)
