"""Held-out episodes on tasks whose operators know more than assistants perceive: the unimpaired operator drives, who knows it too.

Artifact: as that of `heldout`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.judged import HeldoutConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.heldout import HeldoutStage


class InformedHeldoutStage(HeldoutStage):
    """See the module. Thresholds are then taken where an operator without mistakes really drives, not where assistants think so."""

    needs = (*HeldoutStage.needs, "expert")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Run the privileged expert on seeds that no evaluation uses; latents and commands are what an assistant would be given."""
        from wasp_cli.learning.heldout import save_heldout
        from wasp_cli.learning.nominal import expert_episodes, heldout_rows
        from wasp_cli.models.policy import Skills
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.operators.informed import Knowledge
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task

        config = cast(HeldoutConfig, job.config)
        task = make_task(job.task, config.episodes, action_repeat=job.settings["action_repeat"], observe=("pixels",), threads=job.threads)
        seeds = [derive("heldout-episode", job.task, job.seed, i) for i in range(config.episodes)]
        known = cast(Skills, Knowledge(job.inputs["expert"], task))  # nobody imagines here, so that `at` is all that is asked of it
        loop = expert_episodes(task, load_world_model(job.inputs["world_model"]), known, seeds, keep_latents=True)
        save_heldout(heldout_rows(loop), job.out_dir)
        return {"return": float(loop.reward.sum(0).mean()), "cost": float(loop.cost_env.sum(0).mean())}
