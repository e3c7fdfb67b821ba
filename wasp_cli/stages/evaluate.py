"""Evaluation of one cell: a method under one operator and one seed. Artifact: `episodes.parquet`
and `_steps.pq` (see `store.tables`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from wasp_cli.learning.configs.judged import EvaluateConfig
from wasp_cli.stages.base import Job

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from wasp_cli.learning.closed_loop import Loop
    from wasp_cli.methods.base import Assistant, Parts
    from wasp_cli.metrics.episode import EpisodeMetrics, Trajectory
    from wasp_cli.operators.base import Operator, Policy
    from wasp_cli.store.tables import CellIdentity, Rows
    from wasp_cli.tasks.base import VectorTask

SHOWN = {"return": ("return", 2), "cost": ("cost", 1), "int": ("int_rate", 3)}
"""Means that the summary shows: by name, the column of the rows and the digits."""


class EvaluateStage:
    """See the module. The seeds of worlds and of an operator's mistakes follow from task, operator,
    training seed and episode, never from the method.
    """

    kind = "evaluate"
    config = EvaluateConfig
    settings = ("action_repeat", "returns", "side_by_side")
    needs: tuple[str, ...] = ("world_model", "policies")
    needs_informed = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Run the episodes, `side_by_side` of them at a time, and write their rows. Of an earlier
        evaluation with fewer episodes the rows of whole batches are taken over.
        """
        from wasp_cli import seeds
        from wasp_cli.learning.assistants import build_assistant, load_parts, operating_words
        from wasp_cli.learning.closed_loop import batches
        from wasp_cli.learning.device import training_device
        from wasp_cli.learning.informed import informed_policies
        from wasp_cli.store.tables import write_cell
        from wasp_cli.tasks.registry import TASKS

        # -- the frozen models
        config = cast(EvaluateConfig, job.config)
        method: str = job.axes["method"]
        device = training_device()
        motors = TASKS[job.task].motors
        parts = load_parts(job.inputs, job.settings["returns"], device, motors=motors)
        informed = informed_policies(job.task, job.inputs, device)

        # -- the rows that are there already
        size: int = job.settings["side_by_side"]
        earlier = _earlier_rows(job, size)
        begin = 0 if earlier is None else len(earlier.episodes)

        # -- the other episodes. Each batch begins with a new assistant: what it remembers must not
        # depend on the batches before.
        evaluated = _Evaluated()
        for episodes in batches(begin, config.episodes, size):
            assistant = build_assistant(method, job.axes["method_config"], parts)
            task = _task(job, len(episodes))
            operator = _operator(job, episodes, task, parts, informed).to(device)
            loop = _run_batch(job, episodes, task, operator, assistant, parts)
            evaluated.add(job, task, loop)

        # -- all rows of the cell
        layouts = [seeds.layout_seed(job.task, job.seed, e) for e in range(begin, config.episodes)]
        path = write_cell(
            job.out_dir,
            _identity(job),
            evaluated.trajectories,
            evaluated.metrics,
            thresholds_of(assistant),
            evaluated.times,
            layouts,
            earlier,
        )

        # -- summary
        summary: dict[str, Any] = _means(path)
        point = operating_words(method, parts)
        if point is not None:
            summary["operating_point"] = point
        # Tallies are in no row, so those of episodes that were there already are not known.
        if not begin:
            summary |= evaluated.mean_tallies()
        return summary


@dataclass
class _Evaluated:
    """What the episodes of a cell left, in their order."""

    trajectories: list[Trajectory] = field(default_factory=list)
    metrics: list[EpisodeMetrics] = field(default_factory=list)
    times: list[NDArray[Any]] = field(default_factory=list)  # [T] milliseconds, by episode
    tallies: dict[str, list[int]] = field(default_factory=dict)  # what a task counts, by episode

    def add(self, job: Job, task: VectorTask, loop: Loop) -> None:
        """Take the episodes of a batch, and reduce each to its metrics."""
        from wasp_cli.learning.evaluation import trajectories
        from wasp_cli.metrics.episode import episode_metrics
        from wasp_cli.tasks.registry import TASKS

        config = cast(EvaluateConfig, job.config)
        info = TASKS[job.task]
        goals = config.success_goals or info.success_goals
        new, times = trajectories(loop)
        self.trajectories += new
        self.times += times
        for trajectory in new:
            row = episode_metrics(trajectory, goals, config.safe_cost, info.motors.force)
            self.metrics.append(row)
        tallies: Callable[[], Mapping[str, NDArray[np.int64]]] = getattr(task, "tallies", dict)
        for name, counts in tallies().items():
            self.tallies.setdefault(name, []).extend(counts.tolist())

    def mean_tallies(self) -> dict[str, float]:
        """Return the mean of every tally over the episodes."""
        import numpy as np

        return {name: round(float(np.mean(counts)), 2) for name, counts in self.tallies.items()}


def _earlier_rows(job: Job, batch: int) -> Rows | None:
    """Return the rows of whole batches of an earlier evaluation with fewer episodes; None without
    one. Rows of another version are left out: in the rows of one cell a column is defined in all
    or in none.
    """
    from wasp_cli.store.tables import VERSION, cell_file, first_rows, read_version

    if not job.earlier:
        return None
    if read_version(cell_file(job.earlier)) != VERSION:
        return None
    return first_rows(job.earlier, batch)


def _task(job: Job, episodes: int) -> VectorTask:
    """Return the task of a batch, with what assistants and operators perceive."""
    from wasp_cli.learning.informed import observed
    from wasp_cli.tasks.make import make_task

    return make_task(
        job.task,
        episodes,
        action_repeat=job.settings["action_repeat"],
        observe=observed(job.task),
        threads=job.threads,
    )


def _operator(
    job: Job,
    episodes: range,
    task: VectorTask,
    parts: Parts,
    informed: Callable[[float], Policy] | None,
) -> Operator:
    """Return the operator of a batch, with the mistakes of its episodes."""
    from wasp_cli import seeds
    from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator

    driver: str = job.axes["operator"]
    mistakes = EpisodeNoise([seeds.operator_seed(job.task, driver, job.seed, e) for e in episodes])
    context = OperatorContext(parts.skills.at, task.action_size, task.decision_seconds, informed)
    return build_operator(driver, job.axes["value"], context, mistakes, len(episodes))


def _run_batch(
    job: Job,
    episodes: range,
    task: VectorTask,
    operator: Operator,
    assistant: Assistant,
    parts: Parts,
) -> Loop:
    """Run the episodes of a batch side by side."""
    from wasp_cli import seeds
    from wasp_cli.learning.closed_loop import run_episodes

    config = cast(EvaluateConfig, job.config)
    method: str = job.axes["method"]
    driver: str = job.axes["operator"]
    worlds = [seeds.layout_seed(job.task, job.seed, e) for e in episodes]
    draws = [seeds.method_seed(job.task, driver, job.seed, e, method) for e in episodes]

    def during(share: float, text: str) -> None:
        done = (episodes.start + share * len(episodes)) / config.episodes
        job.progress(done, f"episodes {episodes.start}-{episodes[-1]}: {text}")

    return run_episodes(
        task, parts.world_model, operator, assistant, worlds, draws, progress=during
    )


def _identity(job: Job) -> CellIdentity:
    from wasp_cli.store.tables import CellIdentity

    return CellIdentity(
        job.task,
        job.axes["method"],
        job.axes["method_config"].get("variant", "full"),
        job.axes["operator"],
        job.axes["value"],
        job.seed,
    )


def _means(path: Path) -> dict[str, float]:
    """Return means over all episodes of the cell, as they are stored."""
    import numpy as np

    from wasp_cli.store.tables import read_episodes

    numbers = read_episodes([path])
    return {
        name: round(float(np.mean(numbers[column])), digits)
        for name, (column, digits) in SHOWN.items()
    }


def thresholds_of(assistant: object) -> Any:
    """Return the thresholds in force, for every row of the cell; None where an assistant has no
    such threshold.
    """
    from wasp_cli.store.tables import Thresholds

    return Thresholds(
        tau_c=getattr(assistant, "tau_c", None),
        tau_r=getattr(assistant, "tau_r", None),
        tau_q=getattr(assistant, "tau_q", None),
    )
