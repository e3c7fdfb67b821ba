"""Evaluation of one cell: a method under one operator and one seed. Artifact:
`episodes.parquet` and `_steps.pq` (see `store.tables`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.judged import EvaluateConfig
from wasp_cli.stages.base import Job


class EvaluateStage:
    """See the module. Worlds and operator noise are named by task, operator, seed and episode,
    never by the method.
    """

    kind = "evaluate"
    config = EvaluateConfig
    settings = ("action_repeat", "returns", "side_by_side")
    needs: tuple[str, ...] = ("world_model", "policies")
    needs_informed = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Run the episodes, so many side by side, and write their rows; those of whole batches
        that are there are taken over.
        """
        import numpy as np

        from wasp_cli import seeds
        from wasp_cli.learning.assistants import build_assistant, load_parts, operating_words
        from wasp_cli.learning.closed_loop import batches, run_episodes
        from wasp_cli.learning.device import training_device
        from wasp_cli.learning.evaluation import trajectories
        from wasp_cli.learning.informed import informed_policies, observed
        from wasp_cli.metrics.episode import episode_metrics
        from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator
        from wasp_cli.store.tables import (
            VERSION,
            CellIdentity,
            cell_file,
            first_rows,
            read_episodes,
            read_version,
            write_cell,
        )
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.registry import TASKS

        config = cast(EvaluateConfig, job.config)
        method, driver, value = job.axes["method"], job.axes["operator"], job.axes["value"]
        device = training_device()
        parts = load_parts(
            job.inputs, job.settings["returns"], device, motors=TASKS[job.task].motors
        )
        goals = config.success_goals or TASKS[job.task].success_goals
        motors = TASKS[job.task].motors
        informed = informed_policies(job.task, job.inputs, device)
        batch: int = job.settings["side_by_side"]
        # Rows of an earlier version lack columns: in the rows of one cell a column is defined in
        # all, or in none.
        earlier = (
            first_rows(job.earlier, batch)
            if job.earlier and read_version(cell_file(job.earlier)) == VERSION
            else None
        )
        begin = 0 if earlier is None else len(earlier.episodes)
        found, rows, times, layouts = (
            [],
            [],
            [],
            [seeds.layout_seed(job.task, job.seed, e) for e in range(begin, config.episodes)],
        )
        tallied: dict[str, list[int]] = {}
        for episodes in batches(begin, config.episodes, batch):

            def during(share: float, text: str, episodes: range = episodes) -> None:
                done = (episodes.start + share * len(episodes)) / config.episodes
                job.progress(done, f"episodes {episodes.start}-{episodes[-1]}: {text}")

            # Each batch begins anew: what an assistant remembers must not depend on what came
            # before.
            assistant = build_assistant(method, job.axes["method_config"], parts)
            task = make_task(
                job.task,
                len(episodes),
                action_repeat=job.settings["action_repeat"],
                observe=observed(job.task),
                threads=job.threads,
            )
            worlds = [seeds.layout_seed(job.task, job.seed, e) for e in episodes]
            mistakes = EpisodeNoise(
                [seeds.operator_seed(job.task, driver, job.seed, e) for e in episodes]
            )
            own = [seeds.method_seed(job.task, driver, job.seed, e, method) for e in episodes]
            context = OperatorContext(
                parts.skills.at, task.action_size, task.decision_seconds, informed
            )
            operator = build_operator(driver, value, context, mistakes, len(episodes)).to(device)
            loop = run_episodes(
                task, parts.world_model, operator, assistant, worlds, own, progress=during
            )
            new, new_times = trajectories(loop)
            found += new
            times += new_times
            for name, counts in getattr(task, "tallies", dict)().items():
                tallied.setdefault(name, []).extend(counts.tolist())
            rows += [
                episode_metrics(trajectory, goals, config.safe_cost, motors.force)
                for trajectory in new
            ]
        identity = CellIdentity(
            job.task,
            method,
            job.axes["method_config"].get("variant", "full"),
            driver,
            value,
            job.seed,
        )
        path = write_cell(
            job.out_dir, identity, found, rows, thresholds_of(assistant), times, layouts, earlier
        )
        numbers = read_episodes([path])
        shown = {"return": ("return", 2), "cost": ("cost", 1), "int": ("int_rate", 3)}
        means = {
            name: round(float(np.mean(numbers[column])), digits)
            for name, (column, digits) in shown.items()
        }
        words = operating_words(method, parts)
        point = {} if words is None else {"operating_point": words}
        # No column of a row: of episodes that were there already nothing is known.
        return (
            means
            | point
            | {
                name: round(float(np.mean(counts)), 2)
                for name, counts in tallied.items()
                if not begin
            }
        )


def thresholds_of(assistant: object) -> Any:
    """Return the thresholds in force, for every row of the cell."""
    from wasp_cli.store.tables import Thresholds

    return Thresholds(*(getattr(assistant, name, None) for name in ("tau_c", "tau_r", "tau_q")))
