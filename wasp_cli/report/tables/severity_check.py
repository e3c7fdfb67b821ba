"""What `wasp operators` measured: a table for people, and every number for machines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.render.files import RENDERERS
from wasp_cli.report.stats.frame import Frame
from wasp_cli.report.stats.severity_check import KEPT, Difference, Ladder, Rung, difference, judge, verdict_lines, without_moderate
from wasp_cli.report.stats.summary import UNDEFINED, Value, spread_note, summarise
from wasp_cli.report.tables.main import AUTONOMY, PAPER_COLUMNS, missing_notes
from wasp_cli.report.tables.table import Column, Row, Table
from wasp_cli.report.tables.titles import operator_title, task_title

OPTIONAL = ("success", "viol")
MEASURED = tuple(replace(column, optional=column.key in OPTIONAL) for column in PAPER_COLUMNS if column.key not in AUTONOMY)
"""Of an operator alone: nobody intervenes."""
SHARE = Column("share", "of expert (%)", digits=1, scale=100.0, spread=False)
CHANGES = (Column("change", "Change", spread=False), Column("change_se", "SE", spread=False))
COLUMNS = (MEASURED[0], SHARE, *MEASURED[1:], *CHANGES)
CHANGE_NOTE = (
    "Change: mean difference of the return to the next milder severity, of the first to the Expert, in the same episodes; "
    "SE: its standard error over them."
)


def ladder_table(ladders: Sequence[Ladder], frame: Frame) -> Table:
    """Per task the Expert, then each operator variant at every severity."""
    rows: list[Row] = []
    for task, own in groupby(ladders, lambda ladder: ladder.task):
        of_task = list(own)
        expert = of_task[0].expert
        labels = task_title(task), METHODS["expert"].title, _partial(expert)
        rows.append(Row(labels, _values(of_task[0], expert, None)))
        for ladder in of_task:
            for rung, change in zip(ladder.rungs, ladder.changes(), strict=True):
                labels = task_title(task), operator_title(ladder.variant), f"{rung.title} {_partial(rung)}".strip()
                rows.append(Row(labels, _values(ladder, rung, change)))
    notes = (spread_note(frame.cells), *missing_notes(frame), CHANGE_NOTE, *_left_out(ladders))
    return Table("ladder", "Operators alone", ("Task", "Operator", "Severity"), COLUMNS, tuple(rows), notes, ranked=False)


def judged(table: Table, ladders: Sequence[Ladder]) -> Table:
    """The table with the verdicts below it."""
    return replace(table, notes=(*table.notes, *verdict_lines(ladders)))


def write_ladder(folder: Path, table: Table, ladders: Sequence[Ladder]) -> list[Path]:
    """Write the table in every format; the verdicts stand below it where the format has room for them. Returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = judged(table, ladders)
    paths = []
    for ending, render in RENDERERS.items():
        paths.append(folder / f"{table.name}.{ending}")
        paths[-1].write_text(render(whole), encoding="utf-8")
    return paths


def as_json(name: str, ladders: Sequence[Ladder], frame: Frame) -> dict[str, Any]:
    """Every number and verdict; null is undefined.

    Args:
        name: of the spec.
        ladders: all of it, by task.
        frame: what they were made from.

    Returns:
        `share` is of the expert's return, `change` the paired difference to the next milder severity, and `above` that of the
        moderate one to the share of the expert's return that it may keep.
    """
    tasks = []
    for task, own in groupby(ladders, lambda ladder: ladder.task):
        of_task = list(own)
        expert = of_task[0].expert
        tasks.append({"task": task, "expert": _numbers(of_task[0], expert), "operators": [_operator(ladder) for ladder in of_task]})
    return {"spec": name, "tasks": tasks, "missing": [{"cell": cell.label, "reason": cell.reason} for cell in frame.missing]}


def _operator(ladder: Ladder) -> dict[str, Any]:
    verdict, moderate = judge(ladder), ladder.moderate
    changes = zip(ladder.rungs, ladder.changes(), strict=True)
    above = None if moderate is None else difference(moderate.returns, ladder.expert.returns, KEPT)
    return {
        "operator": ladder.variant,
        "outcome": verdict.outcome,
        "reason": verdict.reason,
        "moderate": None if moderate is None else moderate.severity,
        "kept_at_most": KEPT,
        "above": _difference(above),
        "severities": [
            {"severity": rung.severity, "value": rung.value, **_numbers(ladder, rung), "change": _difference(change)}
            for rung, change in changes
        ],
    }


def _numbers(ladder: Ladder, rung: Rung) -> dict[str, Any]:
    numbers: dict[str, Any] = {"episodes": len(rung.returns), "cells": len(rung.cells), "missing": rung.absent}
    for column in MEASURED:
        value = summarise(rung.cells, column.key)
        numbers |= {column.key: value.mean, f"{column.key}_sd": value.sd}
    return {**numbers, "share": ladder.share(rung)}


def _difference(value: Difference | None) -> dict[str, Any] | None:
    return None if value is None else {"mean": value.mean, "se": value.se, "pairs": value.pairs}


def _values(ladder: Ladder, rung: Rung, change: Difference | None) -> tuple[Value, ...]:
    first, *others = (summarise(rung.cells, column.key) for column in MEASURED)
    changed = (UNDEFINED, UNDEFINED) if change is None else (Value(change.mean), Value(change.se))
    return (first, Value(ladder.share(rung)), *others, *changed)


def _partial(rung: Rung) -> str:
    """Says of how many cells a row is the mean, unless all are there."""
    return f"[{len(rung.cells)} of {len(rung.cells) + rung.absent} cells]" if rung.absent else ""


def _left_out(ladders: Sequence[Ladder]) -> Iterator[str]:
    """Where a part of the rule is not applied."""
    for ladder in {ladder.variant: ladder for ladder in ladders}.values():
        if ladder.moderate is None:
            yield f"{operator_title(ladder.variant)}: how much it loses is not judged, since {without_moderate(ladder)}."
    for ladder in {ladder.task: ladder for ladder in ladders}.values():
        if ladder.expert.mean <= 0:
            yield f"{task_title(ladder.task)}: the expert's return is not positive, so that no share of it is defined."
