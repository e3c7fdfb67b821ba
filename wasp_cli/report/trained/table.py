"""How good the trained parts are: what each stage found worth telling, per task."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wasp_cli.plan.node import Part
from wasp_cli.plan.reasons import few
from wasp_cli.report.stats.summary import Value, over_seeds
from wasp_cli.report.tables.table import Column, Row, Table, task_title
from wasp_cli.report.trained.artifacts import Trained

COLUMNS = (
    ("expert", Column("return", "Expert return", digits=1)),
    ("expert", Column("cost", "Expert cost", digits=1)),
    ("expert", Column("success", "Expert succ. (%)", digits=0, scale=100.0, spread=False)),
    ("expert", Column("accepted", "Expert accepted (%)", digits=0, scale=100.0, spread=False, optional=True)),
    ("dataset", Column("costly_share", "Costly data (%)", digits=1, scale=100.0, spread=False)),
    ("policies", Column("return", "Latent return", digits=1)),
    ("policies", Column("privileged_return", "privileged", digits=1, spread=False, optional=True)),
    ("policies", Column("cost", "Latent cost", digits=1)),
    ("policies", Column("privileged_cost", "privileged", digits=1, spread=False, optional=True)),
    ("critics", Column("rank_r", "rank V_r")),
    ("critics", Column("predicted_over_real_r", "V_r / real", optional=True)),
    ("critics", Column("rank_c", "rank V_c")),
    ("critics", Column("predicted_over_real_c", "V_c / real", optional=True)),
)
"""Stage and the number of its summary. Stages that do not tell a number leave its column out."""
MEASURES = (
    Column("auprc", "Cost AUPRC"),
    Column("persistence", "Cost AUPRC, persistence"),
    Column("unseen_auprc", "Cost AUPRC, operators not in the data"),
    Column("base", "Cost base rate"),
    Column("predicted_over_base", "Cost predicted / base rate"),
    Column("recall", "Cost recall"),
    Column("reward_r2", "Reward R²"),
)
"""Numbers of `diagnostics`, each for some imagined steps: `auprc@5`."""
STEPS = (1, 5, 10, 15)
NAMED = 6  # missing parts that a note names; the plan names all
Key = tuple[str, str]  # task and stage of a part


@dataclass(frozen=True)
class _Training:
    """The parts that a run trains, one for each seed of a task and stage, and what those say that are there."""

    wanted: Mapping[Key, list[Part]]
    summaries: Mapping[Part, Mapping[str, Any]]
    failures: Mapping[Part, str]  # why a part is not there, where that is known

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(task for task, _ in self.wanted))

    def parts(self, task: str, stage: str) -> list[Part]:
        return self.wanted.get((task, stage), [])

    def value(self, parts: Sequence[Part], name: str) -> Value:
        """The mean over the seeds whose part is there and tells the number."""
        told = (self.summaries.get(part, {}).get(name) for part in parts)
        numbers = [float(number) for number in told if isinstance(number, int | float) and math.isfinite(number)]
        return over_seeds(numbers, ranked=False)

    def tells(self, parts: Sequence[Part], name: str) -> bool:
        """Whether a part knows the number, be it undefined."""
        return any(name in self.summaries.get(part, {}) for part in parts)

    def missing(self, parts: Sequence[Part]) -> list[Part]:
        return [part for part in parts if part not in self.summaries]


def training_tables(
    parts: Sequence[tuple[Part, str]], trained: Sequence[Trained], failures: Mapping[str, str] | None = None
) -> list[Table]:
    """Make the tables that have something to show; `failures` say by key why parts are not there, where that is known."""
    summaries, why = {artifact.key: artifact.summary for artifact in trained}, failures or {}
    wanted: dict[Key, list[Part]] = {}
    for part, _ in parts:
        wanted.setdefault((part.task, part.kind), []).append(part)
    told = {part: summaries[key] for part, key in parts if key in summaries}
    training = _Training(wanted, told, {part: why[key] for part, key in parts if key in why})
    tables = (_stages(training, _incomplete(training)), _ahead(training))
    return [table for table in tables if table.rows and table.columns]


def _stages(training: _Training, notes: tuple[str, ...]) -> Table:
    """A row for each task."""
    columns, shown = [], []
    for stage, column in COLUMNS:
        read = [training.parts(task, stage) for task in training.tasks]
        # A number that no part tells is no column; one that is still to come is.
        if any(training.missing(own) or training.tells(own, column.key) for own in read):
            columns.append(replace(column, key=f"{stage}.{column.key}"))
            shown.append([training.value(own, column.key) for own in read])
    rows = []
    stages = dict.fromkeys(stage for stage, _ in COLUMNS)
    for i, task in enumerate(training.tasks):
        own = [part for stage in stages for part in training.parts(task, stage)]
        rows.append(Row((task_title(task) + _share(training, own),), tuple(values[i] for values in shown)))
    meanings = (
        "The latent expert drives by the world model's filter; beside it the privileged one that it was distilled from. rank: correlation "
        "of a critic with the discounted sum that really followed in held-out episodes, whose time limit cuts some of it off; / real: the "
        "mean of the critic over that of these sums.",
    )
    return Table("training", "Trained parts", ("Task",), tuple(columns), tuple(rows), notes, meanings, ranked=False)


def _ahead(training: _Training) -> Table:
    """A row for each task and measure, a column for each imagined step."""
    rows = []
    for task in training.tasks:
        judges = training.parts(task, "diagnostics")
        share = _share(training, judges)
        for measure in MEASURES:
            names = [f"{measure.key}@{step}" for step in STEPS]
            values = [training.value(judges, name) for name in names]
            told = any(training.tells(judges, name) for name in names)
            # A measure that no part tells is no row; of what is still to come there is one.
            if told or (share and measure is MEASURES[0]):
                rows.append(Row((task_title(task), measure.title + share), tuple(values)))
    kept = [i for i in range(len(STEPS)) if any(row.values[i].mean is not None for row in rows)] or range(len(STEPS))
    return Table(
        "world_model",
        "World model, imagined steps ahead",
        ("Task", "Measure"),
        tuple(Column(f"step_{STEPS[i]}", str(STEPS[i]), digits=3) for i in kept),
        tuple(Row(row.labels, tuple(row.values[i] for i in kept)) for row in rows),
        meanings=("On held-out episodes. Persistence says that the cost stays what it is now.",),
        ranked=False,
    )


def _incomplete(training: _Training) -> tuple[str, ...]:
    everything = [part for parts in training.wanted.values() for part in parts]
    absent = training.missing(everything)
    if not absent:
        return ()
    absent.sort(key=lambda part: part not in training.failures)  # what failed explains the rest
    names = [f"{part} ({training.failures[part]})" if part in training.failures else str(part) for part in absent]
    return (f"INCOMPLETE: {len(absent)} of {len(everything)} parts are missing: {few(names, NAMED)}.",)


def _share(training: _Training, parts: Sequence[Part]) -> str:
    """How many of the parts behind a row are there, unless all are."""
    absent = len(training.missing(parts))
    return f" [{len(parts) - absent} of {len(parts)} parts]" if absent else ""
