"""Human-only episodes of a mixture of operators, from which a threshold with a guarantee is taken, and further ones that check it.

Artifact: `drives.safetensors`, `drives.json` (see `learning.coverage`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.judged import CoverageConfig
from wasp_cli.stages.base import Job

BATCH = 30
"""Episodes side by side, at most."""


class CoverageStage:
    """See the module."""

    kind = "coverage"
    config = CoverageConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Let operators drawn from the mixture drive, on seeds that no evaluation uses."""
        from wasp_cli.learning.coverage import Facts, mixture_of, record_drives, save_drives
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.tasks.make import make_task

        config = cast(CoverageConfig, job.config)
        episodes = config.episodes + config.fresh
        batch, repeat = min(BATCH, episodes), job.settings["action_repeat"]
        task = make_task(job.task, batch, action_repeat=repeat, observe=("pixels",), threads=job.threads)
        model, skills = load_world_model(job.inputs["world_model"]), load_skills(job.inputs["policies"])
        mixture = mixture_of(config.operators, skills.fractions)
        drives = record_drives(task, model, skills, mixture, episodes, (job.task, job.seed), job.progress)
        save_drives(drives, Facts(mixture, task.decision_seconds, config.episodes), job.out_dir)
        costly = int(drives.episode[drives.cost > 0].unique().numel())
        return {"episodes": episodes, "costly_episodes": costly, "costly_share": float(drives.cost.mean())}
