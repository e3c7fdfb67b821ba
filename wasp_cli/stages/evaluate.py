"""Evaluation of one cell of the grid: a method under one operator and one seed.

Artifact: `cell.parquet` (see `store.tables`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs import EvaluateConfig
from wasp_cli.stages.base import Job


class EvaluateStage:
    """See the module. Worlds and operator noise are named by task, operator, seed and episode, never by the method."""

    kind = "evaluate"
    config = EvaluateConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Run all episodes side by side and write their rows."""
        import numpy as np

        from wasp_cli import seeds
        from wasp_cli.learning.assistants import build_assistant, load_parts
        from wasp_cli.learning.closed_loop import run_episodes
        from wasp_cli.learning.device import training_device
        from wasp_cli.learning.evaluation import trajectories
        from wasp_cli.metrics.episode import episode_metrics
        from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator
        from wasp_cli.store.tables import CellIdentity, write_cell
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.registry import TASKS

        config = cast(EvaluateConfig, job.config)
        method, variant, value = job.axes["method"], job.axes["variant"], job.axes["value"]
        task = make_task(job.task, config.episodes, action_repeat=job.settings["action_repeat"], observe=("pixels",), threads=job.threads)
        device = training_device()
        parts = load_parts(job.inputs, job.settings["returns"], device)
        assistant = build_assistant(method, job.axes["method_config"], parts)
        episodes = range(config.episodes)
        layouts = [seeds.layout_seed(job.task, job.seed, e) for e in episodes]
        mistakes = EpisodeNoise([seeds.operator_seed(job.task, variant, job.seed, e) for e in episodes])
        own = [seeds.method_seed(job.task, variant, job.seed, e, method) for e in episodes]
        context = OperatorContext(parts.skills.at, task.action_size, task.decision_seconds)
        operator = build_operator(variant, value, context, mistakes, config.episodes).to(device)
        loop = run_episodes(task, parts.world_model, operator, assistant, layouts, own, progress=job.progress)

        found, times = trajectories(loop)
        goals = config.success_goals or TASKS[job.task].success_goals
        rows = [episode_metrics(trajectory, goals, config.safe_cost) for trajectory in found]
        identity = CellIdentity(job.task, method, job.axes["method_config"].get("variant", "full"), variant, value, job.seed)
        write_cell(job.out_dir / "cell.parquet", identity, found, rows, thresholds_of(assistant), times, layouts)
        return {
            "return": round(float(np.mean([row.return_ for row in rows])), 2), "cost": round(float(np.mean([row.cost for row in rows])), 1),
            "int": round(float(np.mean([row.int_rate for row in rows])), 3),
        }  # fmt: skip


def thresholds_of(assistant: object) -> Any:
    """Return the thresholds in force, for every row of the cell."""
    from wasp_cli.store.tables import Thresholds

    return Thresholds(*(getattr(assistant, name, None) for name in ("tau_c", "tau_r", "tau_q")))
