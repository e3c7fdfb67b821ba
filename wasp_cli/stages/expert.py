"""Expert: PPO with an adaptive Lagrange multiplier on privileged observations; a skill per checkpoint.

Artifact: `skill-F.safetensors` (+ .json) per checkpoint fraction F, `curve.json` (a row per rollout), `evaluation.json` (a row per
checkpoint; episodes of the deterministic policy on seeds of their own).
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.recorded import ExpertConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.finite import finite_json


class ExpertStage:
    """See the module."""

    kind = "expert"
    config = ExpertConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ()

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train, then evaluate every checkpoint on seeds of its own; goes on from its own state in the work folder."""
        from wasp_cli.learning.expert import best_checkpoint, train_expert
        from wasp_cli.learning.privileged import evaluate_privileged
        from wasp_cli.models.policy import load_privileged
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.registry import TASKS

        config = cast(ExpertConfig, job.config)
        options: dict[str, Any] = {"action_repeat": job.settings["action_repeat"], "observe": ("privileged",), "threads": job.threads}
        curve = train_expert(make_task(job.task, config.envs, **options), config, job.work_dir, job.task, job.seed, job.progress)
        for path in sorted(job.work_dir.glob("skill-*")):
            shutil.copy(path, job.out_dir)
        (job.out_dir / "curve.json").write_text(finite_json(curve))  # no episode may have ended in a rollout: its mean is undefined
        judge = make_task(job.task, config.evaluation_episodes, **options)
        multiplier = sum(row["multiplier"] for row in curve) / len(curve)  # of the whole training
        evaluation, validation = {}, {}
        for fraction in config.checkpoints:
            skill = load_privileged(job.out_dir, fraction)
            sums, checked = (
                evaluate_privileged(judge, skill, [derive(stream, job.task, job.seed, i) for i in range(config.evaluation_episodes)])
                for stream in ("expert-evaluation", "expert-validation")
            )
            evaluation[fraction] = sums.statistics(TASKS[job.task].success_goals)
            validation[fraction] = checked.penalised(multiplier)
        (job.out_dir / "evaluation.json").write_text(finite_json({f"{f:g}": row for f, row in evaluation.items()}))
        first, last = config.checkpoints[0], config.checkpoints[-1]
        return {
            **{name: evaluation[last][name] for name in ("return", "cost", "success")},
            f"return_at_{first:g}": evaluation[first]["return"],
            "multiplier": curve[-1]["multiplier"],
            "best_checkpoint": best_checkpoint(validation),
        }
