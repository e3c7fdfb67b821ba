"""SafeRL-Res: a residual policy trained in the real task. Artifact: `residual.safetensors` (+
.json), `curve.json` (a row per rollout).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.baselines import ResidualConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.expert_limit import expert_limit
from wasp_cli.stages.finite import finite_json


class ResidualStage:
    """See the module."""

    kind = "residual"
    config = ResidualConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("world_model", "policies")
    needs_informed = ("expert",)
    needs_auto = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train and store the mean residual policy."""
        from wasp_cli.learning.informed import informed_policies, observed
        from wasp_cli.learning.residual import train_residual
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.tasks.make import make_task

        # -- the cost limit, which may be that of the expert
        config = cast(ResidualConfig, job.config)
        limit: dict[str, float] = {}
        if config.cost_limit == "auto":
            limit["cost_limit"] = expert_limit(job.inputs["expert"])
            config = config.model_copy(update=limit)

        # -- the task, and the return of the unimpaired expert in it
        model = load_world_model(job.inputs["world_model"])
        task = make_task(
            job.task,
            config.envs,
            action_repeat=job.settings["action_repeat"],
            observe=observed(job.task),
            threads=job.threads,
        )
        informed = informed_policies(job.task, job.inputs)
        skills = json.loads((job.inputs["policies"] / "evaluation.json").read_text())["skills"]
        last_skill = skills[max(skills, key=float)]
        sort = "latent" if informed is None else "privileged"
        expert_return = last_skill[sort]["return"]

        # -- training
        policy, curve = train_residual(
            task,
            model,
            load_skills(job.inputs["policies"]),
            config,
            job.task,
            job.seed,
            job.progress,
            expert_return,
            informed,
        )
        save_weights(
            rounded(policy),
            job.out_dir / "residual.safetensors",
            features=model.feature_size,
            action=task.action_size,
            hidden=list(config.hidden),
        )
        (job.out_dir / "curve.json").write_text(finite_json(curve))
        last = curve[-1]
        return {
            "interactions": last["interactions"],
            "cost_per_1000": last["cost_per_1000"],
            "multiplier": last["multiplier"],
            **limit,
        }
