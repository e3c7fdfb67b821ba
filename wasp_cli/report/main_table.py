"""The paper's Table 1 and what stands behind it: task x method over operator variants and severities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.frame import CellNumbers, Frame, Group, groups
from wasp_cli.report.statistics import over_episodes, spread_note, summarise
from wasp_cli.report.table import UNDEFINED, Column, Row, Table, Value
from wasp_cli.report.titles import assistant_title, operator_title, task_title

PAPER_COLUMNS = (
    Column("return", "Return", "up"),
    Column("success", "Succ. (%)", "up", digits=1, scale=100.0),
    Column("cost", "Cost", "down"),
    Column("viol", "Viol.", "down", digits=3),
    Column("int_rate", "Int.", "down"),
    Column("mag", "Mag.", "down"),
)
MORE_COLUMNS = (
    Column("mag_int", "Mag.|int", "down", optional=True),
    Column("decision_p50_ms", "ms", digits=1, spread=False, optional=True),
)
DETAIL_COLUMNS = (
    Column("goals", "Goals", "up", spread=False),
    Column("safe_success", "Safe succ. (%)", "up", digits=1, scale=100.0, spread=False),
    Column("violated", "Violated (%)", "down", digits=1, scale=100.0, spread=False),
    Column("viol_env", "Viol./env step", "down", digits=3, spread=False),
    Column("int_rate_05", "Int. > 0.05", spread=False),
    Column("int_rate_10", "Int. > 0.10", spread=False),
    Column("smoothness", "Jump²", digits=3, spread=False),
    Column("safety_gate", "Safety gate", digits=3, spread=False),
    Column("task_gate", "Task gate", digits=3, spread=False),
    Column("case2", "Case II", digits=3, spread=False),
    Column("decision_p95_ms", "p95 ms", digits=1, spread=False),
)
COST_COLUMNS = (Column("cost_median", "Cost, median", digits=1), Column("cost_worst", "Cost, worst", digits=0))
AUTONOMY = frozenset({"int_rate", "mag", "mag_int"})
"""Columns in which a method that never acts is not the best, only absent."""

LABELS = ("Task", "Method")
MEANINGS = (
    "Return and Cost are sums over the env steps of an episode. Viol., Int. and Mag. count decision steps and pool the episodes of a cell. "
    "A row is the mean of its cells (operator variants x severities).",
    "Mag. is the mean deviation over all decision steps, Mag.|int over the intervened ones. ms is the median wall time "
    "per decision; the episodes of a cell are decided side by side.",
)
REFERENCE_NOTE = "Expert is the unimpaired operator without assistance, for reference; it is never marked best."


def main_table(frame: Frame) -> Table:
    """Table 1: per task and method the mean over all operator variants and severities."""
    columns = PAPER_COLUMNS + MORE_COLUMNS
    rows = [Row(labels_of(group), values(group, columns)) for group in full_groups(frame)]
    notes = (spread_note(frame.cells), *missing_notes(frame))
    has_reference = any(not METHODS[group.method].impaired for group in full_groups(frame))
    meanings = (*MEANINGS, REFERENCE_NOTE) if has_reference else MEANINGS
    return Table("table1", "Main results", LABELS, columns, tuple(rows), notes, meanings)


def detail_table(frame: Frame) -> Table:
    """The stored columns that Table 1 leaves out."""
    rows = []
    for group in full_groups(frame):
        spread = (over_episodes(group.cells, "cost", np.median), over_episodes(group.cells, "cost", np.max))
        rows.append(Row(labels_of(group), (*spread, *values(group, DETAIL_COLUMNS))))
    meanings = (
        "Median and worst are over all episodes of a row: a mean cost is often carried by few of them.",
        "Jump² is the mean squared change between two executed actions. Case II is its share of the planner's iterations.",
    )
    return Table("details", "More columns", LABELS, COST_COLUMNS + DETAIL_COLUMNS, tuple(rows), meanings=meanings)


def operator_table(frame: Frame) -> Table:
    """Return and cost per operator variant, over its severities."""
    wanted = [group for group in full_groups(frame) if METHODS[group.method].impaired]
    variants = dict.fromkeys(cell.identity.variant for group in wanted for cell in group.cells if cell.identity.variant != UNIMPAIRED)
    columns = [(variant, column) for variant in variants for column in PAPER_COLUMNS if column.key in ("return", "cost")]
    rows = []
    for group in wanted:
        numbers = [part_of(group, group.of_variant(variant), column) for variant, column in columns]
        rows.append(Row(labels_of(group), tuple(numbers)))
    headings = [
        Column(f"{variant}.{column.key}", f"{operator_title(variant)}: {column.title}", column.better, column.digits)
        for variant, column in columns
    ]
    return Table(
        "operators", "Per operator variant", LABELS, tuple(headings), tuple(rows), meanings=("Mean over the severities of a variant.",)
    )


def values(group: Group, columns: Sequence[Column]) -> tuple[Value, ...]:
    """The numbers of a row."""
    return tuple(part_of(group, group.cells, column) for column in columns)


def missing_notes(frame: Frame) -> list[str]:
    """One line when cells are missing; the report names each of them."""
    if not frame.missing:
        return []
    total = len(frame.cells) + len(frame.missing)
    return [f"INCOMPLETE: {len(frame.missing)} of {total} cells are missing. Rows with [x of y cells] are partial and never marked best."]


def part_of(group: Group, cells: Sequence[CellNumbers], column: Column) -> Value:
    """A column over some of the cells of a row."""
    if not cells:
        return UNDEFINED
    value = summarise(cells, column.key)
    # Neither the reference row, nor an incomplete one, nor the autonomy of a method that never acts can be the best.
    idle = column.key in AUTONOMY and value.mean == 0.0
    return replace(value, ranked=value.ranked and group.complete and METHODS[group.method].impaired and not idle)


def full_groups(frame: Frame) -> list[Group]:
    """The rows of assistants as a whole, without ablations."""
    return [group for group in groups(frame) if group.assistant_variant == "full"]


def labels_of(group: Group) -> tuple[str, str]:
    """Task and method of a row."""
    return task_title(group.task), assistant_title(group)
