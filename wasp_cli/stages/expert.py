"""Expert: PPO with an adaptive Lagrange multiplier on privileged observations; a skill per checkpoint.

Artifact: `skill-F.safetensors` (+ .json) per checkpoint fraction F, `curve.json` (a row per rollout), `evaluation.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs import ExpertConfig
from wasp_cli.stages.base import Job


class ExpertStage:
    """See the module."""

    kind = "expert"
    config = ExpertConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ()

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train, then evaluate every checkpoint on seeds of its own."""
        from wasp_cli.learning.expert import evaluate_privileged, load_skill, train_expert
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task

        config = cast(ExpertConfig, job.config)
        options: dict[str, Any] = {"action_repeat": job.settings["action_repeat"], "observe": ("privileged",), "threads": job.threads}
        curve = train_expert(make_task(job.task, config.envs, **options), config, job.out_dir, job.task, job.seed, job.progress)
        (job.out_dir / "curve.json").write_text(json.dumps(curve, indent=1))
        judge = make_task(job.task, config.evaluation_episodes, **options)
        seeds = [derive("expert-evaluation", job.task, job.seed, i) for i in range(config.evaluation_episodes)]
        evaluation = {}
        for fraction in config.checkpoints:
            sums = evaluate_privileged(judge, load_skill(job.out_dir, fraction), seeds)
            evaluation[f"{fraction:g}"] = {
                "return": float(sums.returns.mean()), "cost": float(sums.costs.mean()), "goals": float(sums.goals.mean()),
            }  # fmt: skip
        (job.out_dir / "evaluation.json").write_text(json.dumps(evaluation, indent=1))
        final = evaluation[f"{config.checkpoints[-1]:g}"]
        first = f"{config.checkpoints[0]:g}"
        return {**final, f"return_at_{first}": evaluation[first]["return"], "multiplier": curve[-1]["multiplier"]}
