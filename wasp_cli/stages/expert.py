"""Expert: PPO with an adaptive Lagrange multiplier on privileged observations; a skill per
checkpoint.

Artifact: `skill-F.safetensors` (+ .json) per checkpoint fraction F, the last one with whatever
training was added to reach the bars of its task; `curve.json` (a row per rollout),
`acceptance.json` (a row each time the bars were asked), `evaluation.json` (a row per checkpoint).
"""

from __future__ import annotations

import json
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
        """Train until the bars are reached, then evaluate every checkpoint; goes on from its
        own state in the work folder.
        """
        from wasp_cli.learning.expert import train_expert
        from wasp_cli.learning.privileged import evaluate_privileged
        from wasp_cli.models.policy import PrivilegedPolicy, load_privileged
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.registry import TASKS

        config = cast(ExpertConfig, job.config)
        options: dict[str, Any] = {
            "action_repeat": job.settings["action_repeat"],
            "observe": ("privileged",),
            "threads": job.threads,
        }
        bars, asked = config.bars.get(job.task), job.work_dir / "acceptance.json"

        def measured(
            policy: PrivilegedPolicy, stream: str, episodes: int
        ) -> dict[str, float | None]:
            seeds = [derive(stream, job.task, job.seed, i) for i in range(episodes)]
            return evaluate_privileged(
                make_task(job.task, episodes, **options), policy, seeds
            ).statistics(TASKS[job.task].success_goals)

        def accept(policy: PrivilegedPolicy, interactions: int) -> bool:
            if bars is None:
                return True
            row = measured(policy, "expert-acceptance", config.acceptance_episodes)
            accepted = bars.reached(
                *(float(row[name] or 0) for name in ("return", "success", "cost"))
            )
            rows = json.loads(asked.read_text()) if asked.exists() else []
            # an interrupted training asks again
            rows = [earlier for earlier in rows if earlier["interactions"] < interactions]
            asked.write_text(
                finite_json([*rows, {"interactions": interactions, "accepted": accepted, **row}])
            )
            return accepted

        training = make_task(job.task, config.envs, **options)
        curve = train_expert(
            training, config, job.work_dir, job.task, job.seed, job.progress, accept
        )
        for path in [*sorted(job.work_dir.glob("skill-*")), *([asked] if asked.exists() else [])]:
            shutil.copy(path, job.out_dir)
        # no episode may have ended in a rollout: its mean is undefined
        (job.out_dir / "curve.json").write_text(finite_json(curve))
        evaluation = {
            fraction: measured(
                load_privileged(job.out_dir, fraction),
                "expert-evaluation",
                config.evaluation_episodes,
            )
            for fraction in config.checkpoints
        }
        (job.out_dir / "evaluation.json").write_text(
            finite_json({f"{f:g}": row for f, row in evaluation.items()})
        )
        first, last = config.checkpoints[0], config.checkpoints[-1]
        verdict = (
            {"accepted": json.loads(asked.read_text())[-1]["accepted"]} if asked.exists() else {}
        )
        return {
            **{name: evaluation[last][name] for name in ("return", "cost", "success")},
            f"return_at_{first:g}": evaluation[first]["return"],
            "multiplier": curve[-1]["multiplier"],
            "interactions": int(curve[-1]["interactions"]),
            **verdict,
        }
