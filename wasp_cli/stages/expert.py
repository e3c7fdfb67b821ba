"""Expert: PPO with an adaptive Lagrange multiplier on privileged observations; a skill per
checkpoint.

Artifact: `skill-F.safetensors` (+ .json) per checkpoint fraction F, the last one with whatever
training was added to reach the bars of its task; `curve.json` (a row per rollout),
`acceptance.json` (a row each time the bars were asked), `evaluation.json` (a row per checkpoint),
`references.json` (zero and random commands in some of the same worlds), `limit.json` (its cost
limit, chosen or written).
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping, Sequence
from typing import Any, cast

from wasp_cli.learning.configs.recorded import ExpertConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.expert_limit import LIMIT_FILE, chosen_limit
from wasp_cli.stages.finite import finite_json

# episodes of zero and of random commands, at most as many as evaluate a checkpoint
REFERENCE_EPISODES = 10


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
        from wasp_cli.learning.privileged import (
            evaluate_privileged,
            evaluate_random,
            evaluate_zero,
        )
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

        # -- what commands that look at nothing return and cost, in worlds of the evaluation
        known = min(REFERENCE_EPISODES, config.evaluation_episodes)
        worlds = [derive("expert-evaluation", job.task, job.seed, i) for i in range(known)]
        blind = make_task(job.task, known, **options)
        drawn = derive("expert-random-commands", job.task, job.seed)
        goals = TASKS[job.task].success_goals
        references = {
            "zero": evaluate_zero(blind, worlds).statistics(goals),
            "random": evaluate_random(blind, worlds, drawn).statistics(goals),
        }
        limit: dict[str, float] = {}
        if config.cost_limit == "auto":
            limit["cost_limit"] = chosen_limit(references["random"]["cost_per_1000"] or 0.0)

        # -- training
        training = make_task(job.task, config.envs, **options)
        resolved = config.model_copy(update=limit)
        curve = train_expert(
            training, resolved, job.work_dir, job.task, job.seed, job.progress, accept
        )

        # -- evaluation
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
        (job.out_dir / "references.json").write_text(finite_json(references))
        (job.out_dir / LIMIT_FILE).write_text(json.dumps({"cost_limit": resolved.cost_limit}))
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
            "return_se": standard_error(evaluation[last]),
            "cost_per_1000": evaluation[last]["cost_per_1000"],
            "training_cost_per_1000": late_cost(curve),
            **limit,
            **{name: beside(row) for name, row in references.items()},
        }


def late_cost(curve: Sequence[Mapping[str, float]]) -> float:
    """Return the mean cost per 1000 env steps over the last tenth of a training's rollouts, at least
    one of them.
    """
    rows = curve[-max(1, len(curve) // 10) :]
    return sum(row["cost_per_1000"] for row in rows) / len(rows)


def beside(row: Mapping[str, float | None]) -> dict[str, float | None]:
    """What the summary tells of the episodes of a reference."""
    told = {name: row[name] for name in ("return", "cost", "cost_per_1000")}
    return told | {"return_se": standard_error(row)}


def standard_error(row: Mapping[str, float | None]) -> float | None:
    """Standard error of a mean return over episodes; None for a single one."""
    spread = row["return_sd"]
    episodes = row["episodes"]
    return None if spread is None or not episodes else spread / math.sqrt(episodes)
