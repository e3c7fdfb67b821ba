"""The main table of a report, a row for each task and method: the mean over operator variants and
severities. Also its ablations, what it leaves out, and the same by operator and by severity.

A column is named here and computed in `metrics.episode`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.table import TIMES, CellTable, Floats
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.stats import Frame, Group
from wasp_cli.report.summary import (
    UNDEFINED,
    Value,
    over_episodes,
    over_seeds,
    paired_difference,
    same_episodes,
    spread_note,
    summarise,
)
from wasp_cli.report.tables import Column, Row, Table, assistant_title, operator_title, task_title
from wasp_cli.tasks.registry import TASKS

PAPER_COLUMNS = (
    Column("return", "Return", "up"),
    Column("success", "Succ. (%)", "up", digits=1, scale=100.0),
    Column("cost", "Cost", "down"),
    Column("viol", "Viol.", "down", digits=3),
    Column("int_rate", "Int.", "down"),
    Column("mag", "Mag.", "down"),
)
MORE_COLUMNS = (
    Column("int_eff", "Int. eff.", "down", optional=True),
    Column("mag_eff", "Mag. eff.", "down", optional=True),
    Column("mag_int", "Mag.|int", "down", optional=True),
    Column("decision_p50_ms", "ms", digits=1, spread=False, optional=True, least=True),
)
RATE_COLUMN = Column("viol_env", "Cost/1000", "down", digits=1, scale=1000.0)
"""Cost per 1000 env steps, of tasks of one's own: their episodes may end early, and who dies early
looks safe.
"""
AUTONOMY = frozenset({"int_rate", "mag", "mag_int", "int_eff", "mag_eff"})
"""Columns in which a method that never acts is not the best, only absent."""
OF_COMMANDS = AUTONOMY | {"int_rate_05", "int_rate_10", "jump"}
"""Columns that compare actions with commands: undefined where nobody is at the controls."""

LABELS = ("Task", "Method")
MEANINGS = (
    "Return and Cost are sums over the env steps of an episode. Viol., Int. and Mag. count "
    "decision steps and pool the episodes of a cell. "
    "A row is the mean of its cells (operator variants x severities); of an incomplete one "
    "the mean over seeds of what each has.",
    "Mag. is the mean deviation over all decision steps, Mag.|int over the intervened "
    "ones. ms is the median wall time "
    "per decision; the episodes of a cell are decided side by side.",
    "Int. eff. and Mag. eff. are of the forces: an action beyond what its motor can do is "
    "the same as one at its limit. Rows of earlier "
    "versions do not have them.",
)
REFERENCE_NOTE = (
    "Expert is the unimpaired operator without assistance, for reference; it is never marked best."
)
UNATTENDED_NOTE = (
    "{} drives with nobody at the controls, for reference: it reads no command, so that Int. "
    "and Mag. mean nothing of it."
)


RATE_NOTE = (
    "Cost/1000 is the cost per 1000 env steps: an episode that ends early costs little, and looks "
    "safe by its sum."
)


def main_columns(frame: Frame) -> tuple[Column, ...]:
    """Return the columns of the main table; with a task of one's own, also its cost per step."""
    columns: list[Column] = []
    rated = any(group.task not in TASKS.own for group in full_groups(frame))
    for column in PAPER_COLUMNS:
        columns.append(column)
        if column.key == "cost" and rated:
            columns.append(RATE_COLUMN)
    return (*columns, *MORE_COLUMNS)


def main_table(frame: Frame) -> Table:
    """Make Table 1: a row for each task and method, without ablations."""
    columns = main_columns(frame)
    rows = [Row(labels_of(group), values(group, columns)) for group in full_groups(frame)]
    notes = (spread_note(frame.cells), *missing_notes(frame))
    references = dict.fromkeys(
        group.method for group in full_groups(frame) if not METHODS[group.method].impaired
    )
    told = [
        REFERENCE_NOTE
        if METHODS[method].attended
        else UNATTENDED_NOTE.format(METHODS[method].title)
        for method in references
    ]
    return Table(
        "table1",
        "Main results",
        LABELS,
        columns,
        tuple(rows),
        notes,
        (*MEANINGS, *((RATE_NOTE,) if RATE_COLUMN in columns else ()), *dict.fromkeys(told)),
    )


def values(group: Group, columns: Sequence[Column]) -> tuple[Value, ...]:
    """Return the value of a row in each column."""
    return tuple(part_of(group, group.cells, column) for column in columns)


def missing_notes(frame: Frame) -> list[str]:
    """Return the line of drops: how many cells were planned, and what became of those that are
    not here; the report names each of them.
    """
    total = len(frame.cells) + len(frame.missing)
    if not frame.missing and frame.absent:
        return [
            f"{total} of {total} planned cells of what is installed here are finished; "
            f"none failed. {' '.join(frame.absent)}"
        ]
    if not frame.missing:
        return [
            f"{total} of {total} planned cells are finished; none failed, and none is left out."
        ]
    # The reason begins with what happened: failed, blocked by another node, refused, damaged, or
    # nothing yet.
    fates = Counter(
        "damaged" if each.damaged else each.reason.partition(" ")[0].rstrip(":")
        for each in frame.missing
    )
    said = ", ".join(
        f"{count} {'not computed' if fate == 'not' else fate}" for fate, count in fates.items()
    )
    return [
        f"INCOMPLETE: {len(frame.missing)} of {total} cells are missing ({said}). "
        "Rows with [x of y cells] are partial and never marked best."
    ]


def part_of(group: Group, cells: CellTable, column: Column) -> Value:
    """Return the number of a row over some of its cells."""
    if not len(cells) or (column.key in OF_COMMANDS and not METHODS[group.method].attended):
        return UNDEFINED
    value = summarise(cells, column.key)
    # Neither the reference row, nor an incomplete one, nor the autonomy of a method that never acts
    # can be the best.
    idle = column.key in AUTONOMY and value.mean == 0.0
    return replace(
        value,
        ranked=value.ranked and group.complete and METHODS[group.method].impaired and not idle,
    )


def full_groups(frame: Frame) -> list[Group]:
    """Return the rows of whole methods, without ablations."""
    return [group for group in frame.groups if group.variant == "full"]


def labels_of(group: Group) -> tuple[str, str]:
    """Return the first two labels of a row: the task and the assistant."""
    return task_title(group.task), assistant_title(group)


def ablation_table(frame: Frame) -> Table | None:
    """Make Table 2: per task and variant the values and, in brackets, the paired difference to
    the full method; None without ablations.
    """
    # The methods that have ablations; each whole, then its ablations in the method's own order.
    every = frame.groups
    ablated = {group.method for group in every if group.variant != "full"}
    tasks = list(dict.fromkeys(group.task for group in every))

    def place(group: Group) -> tuple[int, str, int, str]:
        variants = list(METHODS[group.method].variants)
        known = variants.index(group.variant) if group.variant in variants else len(variants)
        return tasks.index(group.task), group.method, known, group.variant

    ablations = sorted((group for group in every if group.method in ablated), key=place)
    if not ablations:
        return None

    # A row for each, an ablation with its difference to the whole method.
    full = {
        (group.task, group.method): group.cells for group in ablations if group.variant == "full"
    }
    rows: list[Row] = []
    alike: list[str] = []
    for group in ablations:
        title = assistant_title(group, name_full=True)
        numbers = values(group, PAPER_COLUMNS)
        reference = full.get((group.task, group.method))
        if group.variant != "full" and reference is not None:
            pairs = zip(numbers, PAPER_COLUMNS, strict=True)
            numbers = tuple(
                replace(value, delta=paired_difference(group.cells, reference, column.key))
                for value, column in pairs
            )
            same, total = same_episodes(group.cells, reference)
            if same:
                which = f"{task_title(group.task)}, {title}: {same} of {total} episodes"
                alike.append(
                    f"{which} are the same as with the full method in what happened and "
                    "what was corrected."
                )
        rows.append(Row((task_title(group.task), title), numbers))

    cells = frame.cells.where(lambda cell: cell.method in ablated)
    meanings = (
        "In brackets: mean difference to the full method over the operators, severities "
        "and seeds that both have.",
    )
    notes = (spread_note(cells), *missing_notes(frame), *alike)
    return Table(
        "table2",
        "Ablations",
        ("Task", "Variant"),
        PAPER_COLUMNS,
        tuple(rows),
        notes,
        meanings,
    )


DETAIL_COLUMNS = (
    Column("goals", "Goals", "up", spread=False),
    Column("safe_success", "Safe succ. (%)", "up", digits=1, scale=100.0, spread=False),
    Column("violated", "Violated (%)", "down", digits=1, scale=100.0, spread=False),
    Column("viol_env", "Viol./env step", "down", digits=3, spread=False),
    Column("int_rate_05", "Int. > 0.05", spread=False),
    Column("int_rate_10", "Int. > 0.10", spread=False),
    Column("smoothness", "Change²", digits=3, spread=False),
    Column("safety_gate", "Safety gate", digits=3, spread=False),
    Column("task_gate", "Task gate", digits=3, spread=False),
    Column("case2", "Case II", digits=3, spread=False),
    Column("decision_p95_ms", "p95 ms", digits=1, spread=False),
)
AUTONOMY_COLUMNS = (
    *(
        column
        for key in ("int_rate", "int_eff", "mag", "mag_eff")
        for column in (*PAPER_COLUMNS, *MORE_COLUMNS)
        if column.key == key
    ),
    Column("jump", "Jump", "down"),
)
COST_COLUMNS = (
    Column("cost_median", "Cost, median", digits=1),
    Column("cost_worst", "Cost, worst", digits=0),
)
THRESHOLD_COLUMNS = (
    Column("tau_c", "tau_c", digits=3),
    Column("tau_r", "tau_r", digits=3),
    Column("tau_q", "tau_Q", digits=3),
)
REDUCE: dict[str, Callable[[Floats], float]] = {"median": np.median, "worst": np.max}
# `p50, median`
LATENCY_COLUMNS = tuple(
    Column(f"{name}.{over}", f"{name.split('_')[1]}, {over}") for name in TIMES for over in REDUCE
)


def detail_table(frame: Frame) -> Table:
    """Make table `details`: measures that the main table leaves out."""
    rows = []
    for group in full_groups(frame):
        spread = (
            over_episodes(group.cells, "cost", np.median),
            over_episodes(group.cells, "cost", np.max),
        )
        rows.append(Row(labels_of(group), (*spread, *values(group, DETAIL_COLUMNS))))
    meanings = (
        "Median and worst are over all episodes of a row: a mean cost is often carried by "
        "few of them.",
        "Change² is the mean squared change between two executed actions. Case II is its "
        "share of the planner's iterations.",
    )
    return Table(
        "details",
        "Further metrics",
        LABELS,
        COST_COLUMNS + DETAIL_COLUMNS,
        tuple(rows),
        meanings=meanings,
    )


def autonomy_table(frame: Frame) -> Table:
    """Make table `autonomy`: how much the assistants change the commands, as actions and as
    forces.
    """
    columns = tuple(replace(column, optional=False) for column in AUTONOMY_COLUMNS)
    rows = [Row(labels_of(group), values(group, columns)) for group in full_groups(frame)]
    meanings = (
        "Int. is the share of the decisions at which the executed action is not the "
        "command, Mag. the mean norm of the difference over all "
        "decisions. Int. eff. and Mag. eff. are the same of the forces, as shares of each "
        "motor's largest: where a motor saturates, two "
        "actions are one force. Of a task whose motors are unknown they are those of the actions.",
        "Jump is the mean norm of the change between two executed actions where an "
        "intervention begins or ends.",
        "Rows of earlier versions have neither forces nor jumps.",
    )
    notes = (spread_note(frame.cells), *missing_notes(frame))
    return Table(
        "autonomy", "What is left to the operator", LABELS, columns, tuple(rows), notes, meanings
    )


def latency_table(frame: Frame) -> Table | None:
    """Make table `latency`: milliseconds of a decision, over the episodes of a row; None where no
    rows have times.
    """
    rows = [
        Row(
            labels_of(group),
            tuple(
                over_episodes(group.cells, name, REDUCE[over]) for name in TIMES for over in REDUCE
            ),
        )
        for group in full_groups(frame)
    ]
    if all(value.mean is None for row in rows for value in row.values):
        return None
    meanings = (
        "Wall time of the assistant's decision in milliseconds; the episodes of a cell are "
        "decided side by side, and share it equally. "
        "p50 and p95 are percentiles over the decisions of an episode, median and worst "
        "are over the episodes of a row.",
        "Times depend on the machine and on what else ran on it; no other number here does.",
    )
    return Table(
        "latency",
        "Time of a decision (ms)",
        ("Task", "Method"),
        LATENCY_COLUMNS,
        tuple(rows),
        meanings=meanings,
        ranked=False,
    )


def threshold_table(frame: Frame) -> Table:
    """Make table `thresholds`: those in force, as means over seeds. It has no rows where
    no method has thresholds.
    """
    rows = []
    for group in frame.groups:
        # A training has the same thresholds in all its cells.
        of_seeds = dict(zip(group.cells.seeds.tolist(), group.cells.thresholds, strict=True))
        numbers = []
        for column in THRESHOLD_COLUMNS:
            values = [getattr(thresholds, column.key) for thresholds in of_seeds.values()]
            known = [value for value in values if value is not None and math.isfinite(value)]
            numbers.append(over_seeds(known, ranked=False))
        if any(value.mean is not None for value in numbers):
            rows.append(Row(labels_of(group), tuple(numbers)))
    meanings = (
        "tau_c: expected costly decision steps, within the horizon (WASP, MPMI) or from "
        "here on (safety filter); tau_r: return; "
        "tau_Q: IDA's advantage. The other methods have no threshold; what each was "
        "calibrated on stands under What was trained.",
    )
    return Table(
        "thresholds",
        "Thresholds in force",
        ("Task", "Method"),
        THRESHOLD_COLUMNS,
        tuple(rows),
        meanings=meanings,
    )


SEVERITY_MEASURES = tuple(
    column
    for key in ("int_rate", "cost", "return")
    for column in PAPER_COLUMNS
    if column.key == key
)


def operator_table(frame: Frame) -> Table:
    """Make table `operators`: return and cost under each operator, over its severities."""
    impaired = [group for group in full_groups(frame) if METHODS[group.method].impaired]
    operators = dict.fromkeys(
        cell.operator for group in impaired for cell in group.cells if cell.operator != UNIMPAIRED
    )
    columns = [
        (operator, column)
        for operator in operators
        for column in PAPER_COLUMNS
        if column.key in ("return", "cost")
    ]
    rows = []
    for group in impaired:
        of_operator = {operator: group.of_operator(operator) for operator in operators}
        numbers = [part_of(group, of_operator[operator], column) for operator, column in columns]
        rows.append(Row(labels_of(group), tuple(numbers)))
    headings = [
        replace(
            column,
            key=f"{operator}.{column.key}",
            title=f"{operator_title(operator)}: {column.title}",
        )
        for operator, column in columns
    ]
    meanings = ("Mean over the severities of a variant.",)
    return Table(
        "operators", "Per operator variant", LABELS, tuple(headings), tuple(rows), meanings=meanings
    )


def severity_table(frame: Frame) -> Table | None:
    """Make table `severity`: per operator the measures at each of its severities; None where no
    operator has two.
    """
    # The severities of each operator.
    impaired = [group for group in full_groups(frame) if METHODS[group.method].impaired]
    cells = [cell for group in impaired for cell in group.cells if has_severity(cell)]
    levels = list(dict.fromkeys(level(cell) for cell in cells))
    of_operator: dict[str, set[str]] = {}
    for cell in cells:
        of_operator.setdefault(cell.operator, set()).add(level(cell))
    if all(len(severities) < 2 for severities in of_operator.values()):
        return None

    # A row for each task, operator and method: every measure at every severity.
    rows = []
    for task in dict.fromkeys(group.task for group in impaired):
        for operator in of_operator:
            for group in impaired:
                if group.task != task:
                    continue
                by_level = _by_level(group.of_operator(operator), levels)
                numbers = [
                    part_of(group, by_level[name], measure)
                    for measure in SEVERITY_MEASURES
                    for name in levels
                ]
                labels = (task_title(task), operator_title(operator), assistant_title(group))
                rows.append(Row(labels, tuple(numbers)))
    columns = tuple(
        replace(measure, key=f"{measure.key}.{name}", title=f"{measure.title} {name}")
        for measure in SEVERITY_MEASURES
        for name in levels
    )

    shown = frame.cells.where(lambda cell: METHODS[cell.method].impaired and has_severity(cell))
    notes = (spread_note(shown), *missing_notes(frame))
    meanings = (
        "An assistant that helps where it is needed intervenes more when the operator gets worse.",
    )
    return Table(
        "severity",
        "Against severity",
        ("Task", "Operator", "Method"),
        columns,
        tuple(rows),
        notes,
        meanings,
        grouping=2,
    )


FURTHER = (
    operator_table,
    severity_table,
    autonomy_table,
    detail_table,
    latency_table,
    threshold_table,
)
"""What makes the tables behind the front ones, in their order."""


def _by_level(cells: CellTable, levels: Sequence[str]) -> dict[str, CellTable]:
    """The cells under each severity."""
    of_cells = [level(cell) if has_severity(cell) else "" for cell in cells]
    places = {name: [i for i, own in enumerate(of_cells) if own == name] for name in levels}
    return {name: cells.choose(own) for name, own in places.items()}


def has_severity(cell: RecordedCell) -> bool:
    """Return whether the value of a cell's operator is a severity; that of a person, or of a
    clone, is a participant's number.
    """
    return cell.value is not None and OPERATORS[cell.operator].simulated


def level(cell: RecordedCell) -> str:
    """Return how severely an operator is impaired, as the spec names it, or its number."""
    return cell.severity or f"{cell.value:g}"


def in_words(frame: Frame) -> list[str]:
    """Say of each task what WASP makes of the operators, and which assistant returns most;
    nothing where either is missing or partial.
    """
    lines = []
    for task in dict.fromkeys(group.task for group in full_groups(frame)):
        whole = {
            group.method: group.cells
            for group in full_groups(frame)
            if group.task == task and group.complete
        }
        if not {"human", "wasp"} <= whole.keys():
            continue
        returns, costs, acts = (
            {m: summarise(cells, key).mean or 0.0 for m, cells in whole.items()}
            for key in ("return", "cost", "int_rate")
        )
        line = (
            f"{task_title(task)}: the operators alone return {returns['human']:.1f} at a "
            f"cost of {costs['human']:.1f}, "
            f"with WASP {returns['wasp']:.1f} at {costs['wasp']:.1f}; it changes "
            f"{acts['wasp']:.0%} of the commands."
        )
        others = [
            m
            for m in whole
            if METHODS[m].impaired and METHODS[m].attended and m not in ("human", "wasp")
        ]
        if others:
            best = max(others, key=returns.__getitem__)
            line += (
                f" Of the others {METHODS[best].title} returns most: {returns[best]:.1f} at "
                f"{costs[best]:.1f}."
            )
        lines.append(line)
    return lines
