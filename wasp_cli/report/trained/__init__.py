"""What was trained for a report: one row per artifact, and tables of how good the parts are.

Files of artifacts are read with care: a results folder may be untrusted. What has no valid form
reads as nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli import console
from wasp_cli.cells.table import Floats
from wasp_cli.errors import ArtifactError, WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.plan.node import Part
from wasp_cli.plan.reasons import few
from wasp_cli.report.provenance import Origins, is_from_published
from wasp_cli.report.render import markdown_row, markdown_text
from wasp_cli.report.summary import Value, over_seeds
from wasp_cli.report.tables import Column, Row, Table, task_title
from wasp_cli.stages.registry import stages_of
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import open_plain, parse, read_plain
from wasp_cli.store.severities import SEVERITY
from wasp_cli.tasks.declared import declare_from
from wasp_cli.tasks.registry import TASKS

SHOWN = 24  # numbers of a stage that fit on a line; the manifests have all

NOT_TRAINED = ("evaluate", *stages_of("cell"))  # kinds whose results are tables of their own


@dataclass(frozen=True)
class Trained:
    stage: str
    task: str
    seed: int
    key: str
    seconds: float | None
    summary: Mapping[str, Any]
    kind: str = ""  # of its node; `stage` says more, for people


def trained_artifacts(
    layout: Layout, roots: Iterable[tuple[str, str]], origins: Origins | None = None
) -> tuple[tuple[Trained, ...], tuple[str, ...]]:
    """Find artifacts and what is behind them, needed ones first, without evaluated cells; and what
    is damaged.

    `roots` are kinds and keys; one that is not there yet is passed over. `origins` takes every
    artifact into account, evaluated cells too.
    """
    origins = origins or Origins()
    visited: set[str] = set()
    artifacts: list[Trained] = []
    damaged: list[str] = []

    def visit(kind: str, key: str) -> None:
        if key in visited or not layout.manifest(kind, key).is_file():
            return
        visited.add(key)
        try:
            manifest = read_manifest(layout, kind, key)
        except ArtifactError as error:
            damaged.append(error.message)
            return
        try:
            for name, needed in manifest["upstream"].items():
                visit(manifest["upstream_kinds"][name], needed)
            method = manifest["axes"].get("method")
            stage = f"{kind} of {METHODS[method].title}" if method in METHODS else kind
            operator = manifest["axes"].get("operator")
            if kind == SEVERITY and operator in OPERATORS:
                stage = f"{kind} of {OPERATORS[operator].title}"
            if is_from_published(manifest):
                stage += ", published"
            declare_from(manifest["task"], manifest.get("settings"))
            seconds = manifest["provenance"].get("seconds")
            trained = Trained(
                stage,
                TASKS[manifest["task"]].name,
                int(manifest["seed"]),
                key,
                None if seconds is None else float(seconds),
                dict(manifest["summary"]),
                kind,
            )
            origins.add(manifest)
        except (
            KeyError,
            TypeError,
            ValueError,
            OverflowError,
            AttributeError,
            RecursionError,
            WaspError,
        ) as error:
            what = " ".join(str(error).split())
            if isinstance(error, KeyError):
                what = f"no '{error.args[0]}'"
            damaged.append(f"'{layout.manifest(kind, key)}' is damaged: {what}")
            return
        if kind not in NOT_TRAINED:
            artifacts.append(trained)  # behind what it needs, which was visited before

    for kind, key in roots:
        visit(kind, key)
    return tuple(artifacts), tuple(damaged)


def trained_markdown(artifacts: Iterable[Trained]) -> str:
    lines = [
        "## What was trained",
        "",
        "| Task | Seed | Stage | Time | Numbers | Key |",
        "| --- | ---: | --- | ---: | --- | --- |",
    ]
    for artifact in artifacts:
        numbers, time = markdown_text(numbers_text(artifact.summary)), duration(artifact.seconds)
        lines.append(
            markdown_row(
                (
                    task_title(artifact.task),
                    artifact.seed,
                    artifact.stage,
                    time,
                    numbers,
                    f"`{artifact.key[:8]}`",
                )
            )
        )
    return "\n".join(lines) + "\n"


def numbers_text(summary: Mapping[str, Any]) -> str:
    numbers = list(scalars(summary))
    text = ", ".join(f"{name} {short(value)}" for name, value in numbers[:SHOWN])
    return text + (f", and {len(numbers) - SHOWN} more" if len(numbers) > SHOWN else "")


def duration(seconds: float | None) -> str:
    return "?" if seconds is None or not math.isfinite(seconds) else console.duration(seconds)


def scalars(
    summary: Mapping[str, Any], prefix: str = ""
) -> Iterable[tuple[str, int | float | bool | str]]:
    for name, value in summary.items():
        if isinstance(value, Mapping):
            yield from scalars(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float | str):
            yield f"{prefix}{name}", value


def short(value: int | float | bool | str) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


PIXELS = (6, 64, 64)  # of a frame: front RGB, then rear RGB
UNREADABLE = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    OSError,
    RecursionError,
    pa.ArrowException,
    WaspError,
)
"""What reading, or showing, a file of another form may raise."""


def read_json(layout: Layout, artifact: Trained, name: str) -> Any:
    """Return what a JSON file of an artifact says; None where there is none or it does not read."""
    with suppress(OSError, ValueError, RecursionError, WaspError):
        return parse(read_plain(layout.within(layout.artifact(artifact.kind, artifact.key) / name)))
    return None


def read_table(layout: Layout, artifact: Trained, name: str, columns: Sequence[str]) -> pa.Table:
    path = layout.within(layout.artifact(artifact.kind, artifact.key) / name)
    with open_plain(path) as plain, pq.ParquetFile(plain) as file:
        return file.read(columns=list(columns), use_threads=False)


def column_of(rows: Sequence[Mapping[str, Any]], name: str) -> Floats:
    """Return a number of every row: [n], NaN where there is none."""
    return np.array([row.get(name) for row in rows], np.float64)


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
    wanted: Sequence[Part]
    summaries: Mapping[Part, Mapping[str, Any]]
    failures: Mapping[Part, str]  # why a part is not there, where that is known

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(part.task for part in self.wanted))

    def parts(self, task: str, stage: str) -> list[Part]:
        return [part for part in self.wanted if (part.task, part.kind) == (task, stage)]

    def value(self, parts: Sequence[Part], name: str) -> Value:
        told = (self.summaries.get(part, {}).get(name) for part in parts)
        numbers = [
            float(number)
            for number in told
            if isinstance(number, int | float) and math.isfinite(number)
        ]
        return over_seeds(numbers, ranked=False)

    def tells(self, parts: Sequence[Part], name: str) -> bool:
        return any(name in self.summaries.get(part, {}) for part in parts)

    def missing(self, parts: Sequence[Part]) -> list[Part]:
        return [part for part in parts if part not in self.summaries]


def training_tables(
    parts: Sequence[tuple[Part, str]],
    trained: Sequence[Trained],
    failures: Mapping[str, str] | None = None,
) -> list[Table]:
    summaries, why = {artifact.key: artifact.summary for artifact in trained}, failures or {}
    told = {part: summaries[key] for part, key in parts if key in summaries}
    training = _Training(
        [part for part, _ in parts], told, {part: why[key] for part, key in parts if key in why}
    )
    tables = (_stages(training, _incomplete(training)), _ahead(training))
    return [table for table in tables if table.rows and table.columns]


def _stages(training: _Training, notes: tuple[str, ...]) -> Table:
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
            told = any(training.tells(judges, name) for name in names)
            # A measure that no part tells is no row; of what is still to come there is one.
            if told or (share and measure is MEASURES[0]):
                rows.append(Row((task_title(task), measure.title + share), tuple(values)))
    kept = [
        i for i in range(len(AHEAD)) if any(row.values[i].mean is not None for row in rows)
    ] or range(len(AHEAD))
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


ALL = "all"  # the row of a dataset's contents that has all behaviours
COSTLY_SHARE = (0.03, 0.15)
"""Share of costly decision steps that a dataset should have: with less a model learns no cost,
with more nothing of driving well.
"""
Document = Mapping[str, Any]


def dataset_warnings(contents: Document) -> list[str]:
    sources, share = contents[ALL]["sources"], contents[ALL]["costly_share"]
    if not sources:
        return []
    warnings = [f"no step costs by {kind}" for kind, part in sources.items() if part == 0.0]
    low, high = COSTLY_SHARE
    if not low <= share <= high:
        warnings.append(f"{share:.1%} of the steps cost, not {low:.0%} to {high:.0%}")
    return warnings


def with_warnings(layout: Layout, trained: Iterable[Trained]) -> tuple[Trained, ...]:
    def judged(artifact: Trained) -> Trained:
        if artifact.kind != "dataset":
            return artifact
        try:
            warnings = dataset_warnings(read_json(layout, artifact, "contents.json"))
        except UNREADABLE:
            return artifact
        return (
            replace(artifact, summary={**artifact.summary, "warning": "; ".join(warnings)})
            if warnings
            else artifact
        )

    return tuple(map(judged, trained))
