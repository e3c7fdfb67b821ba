"""Held-out episodes of the unimpaired expert, from which every threshold is taken. Artifact:
`heldout.safetensors` (a row per decision).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.judged import HeldoutConfig
from wasp_cli.stages.base import Job


class HeldoutStage:
    """See the module."""

    kind = "heldout"
    config = HeldoutConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("world_model", "policies")
    needs_informed = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Run the unimpaired operator on seeds that no evaluation uses."""
        from wasp_cli.learning.heldout import save_heldout
        from wasp_cli.learning.informed import informed_policies, observed
        from wasp_cli.learning.nominal import expert_episodes, heldout_rows
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task

        config = cast(HeldoutConfig, job.config)
        task = make_task(
            job.task,
            config.episodes,
            action_repeat=job.settings["action_repeat"],
            observe=observed(job.task),
            threads=job.threads,
        )
        seeds = [derive("heldout-episode", job.task, job.seed, i) for i in range(config.episodes)]
        model = load_world_model(job.inputs["world_model"])
        skills = load_skills(job.inputs["policies"])
        informed = informed_policies(job.task, job.inputs)
        loop = expert_episodes(task, model, skills, seeds, keep_latents=True, informed=informed)
        save_heldout(heldout_rows(loop), job.out_dir)
        return {
            "return": float(loop.reward.sum(0).mean()),
            "cost": float(loop.cost_env.sum(0).mean()),
        }
