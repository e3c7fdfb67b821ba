"""Tables of how good the trained parts are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wasp_cli.plan.node import Part
from wasp_cli.plan.reasons import few
from wasp_cli.report.summary import Value, over_seeds
from wasp_cli.report.tables import Column, Row, Table, task_title
from wasp_cli.report.trained.artifacts import Trained

# stage and the number of its summary. Stages that do not tell a number leave its column out.
COLUMNS = (
    ("expert", Column("return", "Expert return", digits=1)),
    ("expert", Column("cost", "Expert cost", digits=1)),
    ("expert", Column("success", "Expert succ. (%)", digits=0, scale=100.0, spread=False)),
    (
        "expert",
        Column(
            "accepted", "Expert accepted (%)", digits=0, scale=100.0, spread=False, optional=True
        ),
    ),
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
MEASURES = (  # numbers of `diagnostics`, each for some imagined steps: `auprc@5`
    Column("auprc", "Cost AUPRC"),
    Column("persistence", "Cost AUPRC, persistence"),
    Column("unseen_auprc", "Cost AUPRC, operators not in the data"),
    Column("base", "Cost base rate"),
    Column("predicted_over_base", "Cost predicted / base rate"),
    Column("recall", "Cost recall"),
    Column("reward_r2", "Reward R²"),
)
AHEAD = (1, 5, 10, 15)  # imagined steps
NAMED = 6  # missing parts that a note names; the plan names all


@dataclass(frozen=True)
class _Training:
    """The parts that a run was to train, and what those that are there say of themselves."""

    wanted: Sequence[Part]
    summaries: Mapping[Part, Mapping[str, Any]]
    failures: Mapping[Part, str]  # why a part is not there, where that is known

    @property
    def tasks(self) -> list[str]:
        """The tasks of the parts, each once."""
        return list(dict.fromkeys(part.task for part in self.wanted))

    def parts(self, task: str, stage: str) -> list[Part]:
        """Return the parts of a stage on a task, one for each training seed."""
        return [part for part in self.wanted if (part.task, part.kind) == (task, stage)]

    def value(self, parts: Sequence[Part], name: str) -> Value:
        """Return a number of some parts over their seeds, of those that have it."""
        numbers = []
        for part in parts:
            number = self.summaries.get(part, {}).get(name)
            if isinstance(number, int | float) and math.isfinite(number):
                numbers.append(float(number))
        return over_seeds(numbers, ranked=False)

    def has(self, parts: Sequence[Part], name: str) -> bool:
        """Return whether any of some parts has a number of this name."""
        return any(name in self.summaries.get(part, {}) for part in parts)

    def missing(self, parts: Sequence[Part]) -> list[Part]:
        """Return those of some parts that are not there."""
        return [part for part in parts if part not in self.summaries]


def training_tables(
    parts: Sequence[tuple[Part, str]],
    trained: Sequence[Trained],
    failures: Mapping[str, str] | None = None,
) -> list[Table]:
    """Return the tables of what was trained, without those that have nothing to show.

    Args:
        parts: the parts of a run, each with its key.
        trained: those that are there.
        failures: by key, why a part is not there, where that is known.
    """
    reasons = failures or {}
    summaries = {artifact.key: artifact.summary for artifact in trained}
    training = _Training(
        wanted=[part for part, _ in parts],
        summaries={part: summaries[key] for part, key in parts if key in summaries},
        failures={part: reasons[key] for part, key in parts if key in reasons},
    )
    tables = (_stages(training, _incomplete(training)), _ahead(training))
    return [table for table in tables if table.rows and table.columns]


def _stages(training: _Training, notes: tuple[str, ...]) -> Table:
    columns = []
    shown: list[list[Value]] = []  # by column the values of all tasks
    for stage, column in COLUMNS:
        by_task = [training.parts(task, stage) for task in training.tasks]
        # A number that no part has is no column; one that is still to come is.
        if any(training.missing(own) or training.has(own, column.key) for own in by_task):
            columns.append(replace(column, key=f"{stage}.{column.key}"))
            shown.append([training.value(own, column.key) for own in by_task])
    rows = []
    stages = dict.fromkeys(stage for stage, _ in COLUMNS)
    for i, task in enumerate(training.tasks):
        own = [part for stage in stages for part in training.parts(task, stage)]
        rows.append(
            Row((task_title(task) + _share(training, own),), tuple(values[i] for values in shown))
        )
    meanings = (
        "The latent expert drives by the world model's filter; beside it the privileged "
        "one that it was distilled from. rank: correlation "
        "of a critic with the discounted sum that really followed in held-out episodes, "
        "whose time limit cuts some of it off; / real: the "
        "mean of the critic over that of these sums.",
    )
    return Table(
        "training",
        "Trained parts",
        ("Task",),
        tuple(columns),
        tuple(rows),
        notes,
        meanings,
        ranked=False,
    )


def _ahead(training: _Training) -> Table:
    rows = []
    for task in training.tasks:
        judges = training.parts(task, "diagnostics")
        share = _share(training, judges)
        for measure in MEASURES:
            names = [f"{measure.key}@{step}" for step in AHEAD]
            values = [training.value(judges, name) for name in names]
            known = any(training.has(judges, name) for name in names)
            # A measure that no part has is no row; of what is still to come there is one.
            if known or (share and measure is MEASURES[0]):
                rows.append(Row((task_title(task), measure.title + share), tuple(values)))
    # Without columns that are empty in every row, as long as any is not.
    every = range(len(AHEAD))
    kept = [i for i in every if any(row.values[i].mean is not None for row in rows)] or every
    columns = tuple(Column(f"step_{AHEAD[i]}", str(AHEAD[i]), digits=3) for i in kept)
    shown = tuple(Row(row.labels, tuple(row.values[i] for i in kept)) for row in rows)
    meanings = ("On held-out episodes. Persistence says that the cost stays what it is now.",)
    return Table(
        "world_model",
        "World model, imagined steps ahead",
        ("Task", "Measure"),
        columns,
        shown,
        meanings=meanings,
        ranked=False,
    )


def _incomplete(training: _Training) -> tuple[str, ...]:
    absent = training.missing(training.wanted)
    if not absent:
        return ()
    absent.sort(key=lambda part: part not in training.failures)  # what failed explains the rest
    names = [
        f"{part} ({training.failures[part]})" if part in training.failures else str(part)
        for part in absent
    ]
    return (
        f"INCOMPLETE: {len(absent)} of {len(training.wanted)} parts are missing: "
        f"{few(names, NAMED)}.",
    )


def _share(training: _Training, parts: Sequence[Part]) -> str:
    absent = len(training.missing(parts))
    return f" [{len(parts) - absent} of {len(parts)} parts]" if absent else ""
