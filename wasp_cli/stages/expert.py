"""Expert: PPO with an adaptive Lagrange multiplier on privileged observations; a skill per
checkpoint.

Artifact: `skill-F.safetensors` (+ .json) per checkpoint fraction F, the last one with the training
that was added to reach the bars of its task; `curve.json` (a row per rollout), `acceptance.json` (a
row each time the policy was compared with the bars), `evaluation.json` (a row per checkpoint),
`references.json` (zero and random commands in some of the same worlds), `limit.json` (the cost
limit, as it was set or chosen); on a task of one's own also `acting.json` (how it acts without
exploration, and what it did both ways).
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

REFERENCE_EPISODES = 10
"""Episodes of zero and of random commands; not more than those that evaluate a checkpoint."""
ACTING_EPISODES = 32
"""Episodes of each way of acting; not more than three times those that evaluate a checkpoint."""


class ExpertStage:
    """See the module."""

    kind = "expert"
    config = ExpertConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ()

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train until the bars are reached, then evaluate every checkpoint. An interrupted training
        goes on from its own state in the work folder.
        """
        from wasp_cli.learning.acting import better_acting
        from wasp_cli.learning.expert import train_expert
        from wasp_cli.learning.privileged import (
            evaluate_privileged,
            evaluate_random,
            evaluate_zero,
        )
        from wasp_cli.models.policy import (
            Acts,
            PrivilegedPolicy,
            checkpoint_name,
            let_act,
            load_privileged,
        )
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.registry import TASKS

        config = cast(ExpertConfig, job.config)
        options: dict[str, Any] = {
            "action_repeat": job.settings["action_repeat"],
            "observe": ("privileged",),
            "threads": job.threads,
        }
        bars = config.bars.get(job.task)
        goals = TASKS[job.task].success_goals
        acceptance_file = job.work_dir / "acceptance.json"

        def measured(
            policy: PrivilegedPolicy, stream: str, episodes: int
        ) -> dict[str, float | None]:
            """Drive fresh episodes, and return their statistics."""
            seeds = [derive(stream, job.task, job.seed, i) for i in range(episodes)]
            task = make_task(job.task, episodes, **options)
            return evaluate_privileged(task, policy, seeds).statistics(goals)

        def accept(policy: PrivilegedPolicy, interactions: int) -> bool:
            """Compare a policy with the bars, and write the comparison down."""
            if bars is None:
                return True
            row = measured(policy, "expert-acceptance", config.acceptance_episodes)
            accepted = bars.reached(
                float(row["return"] or 0), float(row["success"] or 0), float(row["cost"] or 0)
            )
            rows = json.loads(acceptance_file.read_text()) if acceptance_file.exists() else []
            # A training that was interrupted in between compares the same policy again.
            rows = [earlier for earlier in rows if earlier["interactions"] < interactions]
            rows.append({"interactions": interactions, "accepted": accepted, **row})
            acceptance_file.write_text(finite_json(rows))
            return accepted

        def acting() -> dict[str, Any]:
            """Drive the last checkpoint both ways in the same worlds. Returns `acts`, the better
            one, and the statistics of `mode` and `mean`.
            """
            episodes = min(ACTING_EPISODES, 3 * config.evaluation_episodes)
            seeds = [derive("expert-acting", job.task, job.seed, i) for i in range(episodes)]
            policy = load_privileged(job.out_dir, config.checkpoints[-1])
            ways: tuple[Acts, Acts] = ("mode", "mean")
            sums = {}
            for way in ways:
                policy.acts = way
                task = make_task(job.task, episodes, **options)
                sums[way] = evaluate_privileged(task, policy, seeds)
            found: dict[str, Any] = {way: sums[way].statistics(goals) for way in ways}
            found["acts"] = better_acting(sums["mode"], sums["mean"])
            return found

        # -- references: zero and random commands, in worlds of the evaluation
        count = min(REFERENCE_EPISODES, config.evaluation_episodes)
        worlds = [derive("expert-evaluation", job.task, job.seed, i) for i in range(count)]
        task = make_task(job.task, count, **options)
        stream = derive("expert-random-commands", job.task, job.seed)
        references = {
            "zero": evaluate_zero(task, worlds).statistics(goals),
            "random": evaluate_random(task, worlds, stream).statistics(goals),
        }

        # -- the cost limit, which may follow from them
        limit: dict[str, float] = {}
        if config.cost_limit == "auto":
            limit["cost_limit"] = chosen_limit(references["random"]["cost_per_1000"] or 0.0)

        # -- training
        training = make_task(job.task, config.envs, **options)
        resolved = config.model_copy(update=limit)
        curve = train_expert(
            training, resolved, job.work_dir, job.task, job.seed, job.progress, accept
        )

        for path in sorted(job.work_dir.glob("skill-*")):
            shutil.copy(path, job.out_dir)
        if acceptance_file.exists():
            shutil.copy(acceptance_file, job.out_dir)
        # A rollout in which no episode ended has undefined means.
        (job.out_dir / "curve.json").write_text(finite_json(curve))

        # -- how it acts without exploration; the experts of our own tasks act by the mode
        if job.task not in TASKS.own:
            found = acting()
            (job.out_dir / "acting.json").write_text(finite_json(found))
            if found["acts"] == "mean":
                for fraction in config.checkpoints:
                    let_act(job.out_dir / checkpoint_name(fraction), "mean")

        # -- evaluation of every checkpoint
        evaluation: dict[float, dict[str, float | None]] = {}
        for fraction in config.checkpoints:
            policy = load_privileged(job.out_dir, fraction)
            evaluation[fraction] = measured(policy, "expert-evaluation", config.evaluation_episodes)
        by_name = {f"{fraction:g}": row for fraction, row in evaluation.items()}
        (job.out_dir / "evaluation.json").write_text(finite_json(by_name))
        (job.out_dir / "references.json").write_text(finite_json(references))
        (job.out_dir / LIMIT_FILE).write_text(json.dumps({"cost_limit": resolved.cost_limit}))

        # -- summary
        first = evaluation[config.checkpoints[0]]
        last = evaluation[config.checkpoints[-1]]
        summary: dict[str, Any] = {
            "return": last["return"],
            "cost": last["cost"],
            "success": last["success"],
            f"return_at_{config.checkpoints[0]:g}": first["return"],
            "multiplier": curve[-1]["multiplier"],
            "interactions": int(curve[-1]["interactions"]),
        }
        if acceptance_file.exists():
            summary["accepted"] = json.loads(acceptance_file.read_text())[-1]["accepted"]
        summary["return_se"] = standard_error(last)
        summary["cost_per_1000"] = last["cost_per_1000"]
        summary["training_cost_per_1000"] = late_cost(curve)
        summary |= limit
        for name, row in references.items():
            summary[name] = summary_of_reference(row)
        return summary


def late_cost(curve: Sequence[Mapping[str, float]]) -> float:
    """Return the mean cost per 1000 env steps over the last tenth of the rollouts of a training, at
    least one of them.
    """
    rows = curve[-max(1, len(curve) // 10) :]
    return sum(row["cost_per_1000"] for row in rows) / len(rows)


def summary_of_reference(row: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return what the summary shows of the episodes of a reference."""
    return {
        "return": row["return"],
        "cost": row["cost"],
        "cost_per_1000": row["cost_per_1000"],
        "return_se": standard_error(row),
    }


def standard_error(row: Mapping[str, float | None]) -> float | None:
    """Return the standard error of a mean return over episodes; None for a single episode."""
    deviation = row["return_sd"]
    episodes = row["episodes"]
    if deviation is None or not episodes:
        return None
    return deviation / math.sqrt(episodes)
