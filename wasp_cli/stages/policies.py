"""Policies: latent actors distilled from every expert checkpoint.

Artifact: `skills.safetensors` (+ .json), `evaluation.json` (the latent expert in the real task beside the privileged one).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs import PoliciesConfig
from wasp_cli.stages.base import Job


class PoliciesStage:
    """See the module."""

    kind = "policies"
    config = PoliciesConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert", "dataset", "world_model")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Distil, then drive the real task with the latent expert."""
        import torch

        from wasp_cli.learning.closed_loop import expert_episodes
        from wasp_cli.learning.expert import load_skill
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.policies import distil, save_skills
        from wasp_cli.learning.replay import read_replay
        from wasp_cli.learning.trained import load_world_model
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task

        config = cast(PoliciesConfig, job.config)
        privileged = json.loads((job.inputs["expert"] / "evaluation.json").read_text())
        fractions = sorted(float(f) for f in privileged)
        experts = [load_skill(job.inputs["expert"], f) for f in fractions]
        replay = read_replay(job.inputs["dataset"], ["privileged", "action", "first"])
        latents = load_latents(job.inputs["world_model"])
        torch.manual_seed(derive("policies-weights", job.task, job.seed))
        skills, explained = distil(
            experts, fractions, replay, latents, config, derive("policies", job.task, job.seed), lambda s, t: job.progress(0.7 * s, t)
        )
        model = load_world_model(job.inputs["world_model"])
        save_skills(skills, job.out_dir, model.feature_size, config.hidden, model.action_size)
        task = make_task(
            job.task, config.evaluation_episodes, action_repeat=job.settings["action_repeat"], observe=("pixels",), threads=job.threads
        )
        seeds = [derive("policies-evaluation", job.task, job.seed, i) for i in range(config.evaluation_episodes)]
        loop = expert_episodes(task, model, skills, seeds)
        latent = {"return": float(loop.reward.sum(0).mean()), "cost": float(loop.cost_env.sum(0).mean())}
        evaluation = {"latent": latent, "privileged": privileged, "explained": explained}
        (job.out_dir / "evaluation.json").write_text(json.dumps(evaluation, indent=1))
        expert = privileged[f"{fractions[-1]:g}"]
        return {
            **latent, "privileged_return": expert["return"], "privileged_cost": expert["cost"], "explained": round(explained["1"], 3),
        }  # fmt: skip
