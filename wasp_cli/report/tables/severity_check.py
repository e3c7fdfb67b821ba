"""What `wasp severities` measured: a table for people, and every number for machines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.stats.frame import Frame
from wasp_cli.report.stats.severity_check import (
    KEPT,
    Difference,
    SeverityCheck,
    SeverityLevel,
    difference,
    judge,
    verdict_lines,
    without_moderate,
)
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


def check_table(checks: Sequence[SeverityCheck], frame: Frame) -> Table:
    """Tabulate per task the Expert, then each operator variant at every severity."""
    rows: list[Row] = []
    for task, own in groupby(checks, lambda check: check.task):
        of_task = list(own)
        expert = of_task[0].expert
        labels = task_title(task), METHODS["expert"].title, _partial(expert)
        rows.append(Row(labels, _values(of_task[0], expert, None)))
        for check in of_task:
            for level, change in zip(check.levels, check.changes(), strict=True):
                labels = task_title(task), operator_title(check.operator), f"{level.title} {_partial(level)}".strip()
                rows.append(Row(labels, _values(check, level, change)))
    notes = (spread_note(frame.cells), *missing_notes(frame), CHANGE_NOTE, *_left_out(checks))
    return Table("severity_check", "Operators alone", ("Task", "Operator", "Severity"), COLUMNS, tuple(rows), notes, ranked=False)


def judged(table: Table, checks: Sequence[SeverityCheck]) -> Table:
    """Return the table with the verdicts below it."""
    return replace(table, notes=(*table.notes, *verdict_lines(checks)))


def as_json(name: str, checks: Sequence[SeverityCheck], frame: Frame) -> dict[str, Any]:
    """Return every number and verdict; null is undefined.

    Args:
        name: of the spec.
        checks: all of it, by task.
        frame: what they were made from.

    Returns:
        `share` is of the expert's return, `change` the paired difference to the next milder severity, and `above` that of the
        moderate one to the share of the expert's return that it may keep.
    """
    tasks = []
    for task, own in groupby(checks, lambda check: check.task):
        of_task = list(own)
        expert = of_task[0].expert
        tasks.append({"task": task, "expert": _numbers(of_task[0], expert), "operators": [_operator(check) for check in of_task]})
    return {"spec": name, "tasks": tasks, "missing": [{"cell": cell.label, "reason": cell.reason} for cell in frame.missing]}


def _operator(check: SeverityCheck) -> dict[str, Any]:
    verdict, moderate = judge(check), check.moderate
    changes = zip(check.levels, check.changes(), strict=True)
    above = None if moderate is None else difference(moderate.returns, check.expert.returns, KEPT)
    return {
        "operator": check.operator,
        "outcome": verdict.outcome,
        "reason": verdict.reason,
        "moderate": None if moderate is None else moderate.severity,
        "kept_at_most": KEPT,
        "above": _difference(above),
        "severities": [
            {"severity": level.severity, "value": level.value, **_numbers(check, level), "change": _difference(change)}
            for level, change in changes
        ],
    }


def _numbers(check: SeverityCheck, level: SeverityLevel) -> dict[str, Any]:
    numbers: dict[str, Any] = {"episodes": len(level.returns), "cells": len(level.cells), "missing": level.absent}
    for column in MEASURED:
        value = summarise(level.cells, column.key)
        numbers |= {column.key: value.mean, f"{column.key}_sd": value.sd}
    return {**numbers, "share": check.share(level)}


def _difference(value: Difference | None) -> dict[str, Any] | None:
    return None if value is None else {"mean": value.mean, "se": value.se, "pairs": value.pairs}


def _values(check: SeverityCheck, level: SeverityLevel, change: Difference | None) -> tuple[Value, ...]:
    first, *others = (summarise(level.cells, column.key) for column in MEASURED)
    changed = (UNDEFINED, UNDEFINED) if change is None else (Value(change.mean), Value(change.se))
    return (first, Value(check.share(level)), *others, *changed)


def _partial(level: SeverityLevel) -> str:
    """Says of how many cells a row is the mean, unless all are there."""
    return f"[{len(level.cells)} of {len(level.cells) + level.absent} cells]" if level.absent else ""


def _left_out(checks: Sequence[SeverityCheck]) -> Iterator[str]:
    """Where a part of the rule is not applied."""
    for check in {check.operator: check for check in checks}.values():
        if check.moderate is None:
            yield f"{operator_title(check.operator)}: how much it loses is not judged, since {without_moderate(check)}."
    for check in {check.task: check for check in checks}.values():
        if check.expert.mean <= 0:
            yield f"{task_title(check.task)}: the expert's return is not positive, so that no share of it is defined."
