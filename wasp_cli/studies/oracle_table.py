"""What `wasp bench ceiling` measured, for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from wasp_cli.console import duration
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.main_table import PAPER_COLUMNS
from wasp_cli.report.table import Column, Row, Table, Value
from wasp_cli.report.titles import operator_title, task_title, who_title

if TYPE_CHECKING:
    from wasp_cli.studies.oracle import Cell, Outcome

COLUMNS = (
    *PAPER_COLUMNS,
    Column("safety_gate", "Safety gate", digits=3),
    Column("task_gate", "Task gate", digits=3),
    Column("case2", "Case II", digits=3, optional=True),
)
COMPARED = ("return", "cost")
"""Columns with a spread over episodes, and the difference to Human-only."""
MEANINGS = (
    "WASP imagines in the task itself: its model is perfect, and knows where the next goals will be. The imagined operator makes mistakes "
    "of its own, and nothing is foreseen beyond the horizon. Operator and imagination read the privileged observation.",
    "± is the standard deviation over episodes, in brackets the mean difference to Human-only in the same episodes.",
)


def ceiling_table(cell: Cell, found: Sequence[Outcome]) -> Table:
    """A row per assistant, Human-only first."""
    alone = found[0]
    rows = [Row((_title(outcome),), tuple(_value(outcome, alone, column) for column in COLUMNS)) for outcome in found]
    episodes = f"{cell.episodes} episode{'s' if cell.episodes > 1 else ''}"
    title = f"Ceiling: {task_title(cell.task)}, {operator_title(cell.variant)} {cell.value:g}, seed {cell.seed}, {episodes}"
    times = ", ".join(f"{_title(outcome)} {duration(outcome.seconds)}" for outcome in found)
    notes = (f"time: {times}",)
    return Table("ceiling", title, ("Method",), COLUMNS, tuple(rows), notes, MEANINGS, grouped=False, ranked=False)


def _title(outcome: Outcome) -> str:
    if outcome.variant is None:
        return METHODS["human"].title
    return who_title("wasp", outcome.variant)


def _value(outcome: Outcome, alone: Outcome, column: Column) -> Value:
    mean = outcome.pooled()[column.key]
    if column.key not in COMPARED:
        return Value(mean)
    values, reference = outcome.column(column.key), alone.column(column.key)
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Value(mean, sd, delta=None if outcome is alone else float((values - reference).mean()))
