"""What Table 1 leaves out: further metrics, how long a decision takes, and the thresholds in force."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from wasp_cli.report.stats.frame import TIMES, CellNumbers, Floats, Frame, groups
from wasp_cli.report.stats.summary import Value, over_episodes, over_seeds
from wasp_cli.report.tables.main import LABELS, full_groups, labels_of, values
from wasp_cli.report.tables.table import Column, Row, Table
from wasp_cli.report.tables.titles import assistant_title, task_title

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
LATENCY_COLUMNS = tuple(
    Column(f"{name}.{over}", f"{share}, {over}", digits=2)
    for name, share in zip(TIMES, ("p50", "p95"), strict=True)
    for over in ("median", "worst")
)
THRESHOLD_COLUMNS = (
    Column("tau_c", "tau_c", digits=3),
    Column("tau_r", "tau_r", digits=3),
    Column("tau_q", "tau_Q", digits=3),
)
REDUCE: dict[str, Callable[[Floats], float]] = {"median": np.median, "worst": np.max}


def detail_table(frame: Frame) -> Table:
    """Tabulate the stored columns that Table 1 leaves out."""
    rows = []
    for group in full_groups(frame):
        spread = (over_episodes(group.cells, "cost", np.median), over_episodes(group.cells, "cost", np.max))
        rows.append(Row(labels_of(group), (*spread, *values(group, DETAIL_COLUMNS))))
    meanings = (
        "Median and worst are over all episodes of a row: a mean cost is often carried by few of them.",
        "Jump² is the mean squared change between two executed actions. Case II is its share of the planner's iterations.",
    )
    return Table("details", "Further metrics", LABELS, COST_COLUMNS + DETAIL_COLUMNS, tuple(rows), meanings=meanings)


def latency_table(frame: Frame) -> Table | None:
    """Tabulate per task and method median and 95th percentile of the time of a decision (ms); None where nothing has been timed."""
    rows = [
        Row(labels_of(group), tuple(over_episodes(group.cells, name, REDUCE[over]) for name in TIMES for over in REDUCE))
        for group in full_groups(frame)
    ]
    if all(value.mean is None for row in rows for value in row.values):
        return None
    meanings = (
        "Wall time of the assistant's decision in milliseconds; the episodes of a cell are decided side by side, and share it equally. "
        "p50 and p95 are percentiles over the decisions of an episode, median and worst are over the episodes of a row.",
        "Times depend on the machine and on what else ran on it; no other number here does.",
    )
    return Table("latency", "Time of a decision (ms)", ("Task", "Method"), LATENCY_COLUMNS, tuple(rows), meanings=meanings, ranked=False)


def threshold_table(frame: Frame) -> Table:
    """Tabulate per task and assistant the mean threshold over seeds; without rows when no method has one."""
    rows = []
    for group in groups(frame):
        numbers = tuple(_threshold(group.cells, column.key) for column in THRESHOLD_COLUMNS)
        if any(value.mean is not None for value in numbers):
            rows.append(Row((task_title(group.task), assistant_title(group, ablation=group.assistant_variant != "full")), numbers))
    meanings = (
        "tau_c: expected costly decision steps, within the horizon (WASP) or from here on (safety filter); tau_r: return; "
        "tau_Q: IDA's advantage. The other methods have no threshold; what each was calibrated on stands under What was trained.",
    )
    return Table("thresholds", "Thresholds in force", ("Task", "Method"), THRESHOLD_COLUMNS, tuple(rows), meanings=meanings)


def _threshold(cells: tuple[CellNumbers, ...], key: str) -> Value:
    by_seed = {cell.identity.seed: getattr(cell.thresholds, key) for cell in cells}
    return over_seeds((value for value in by_seed.values() if value is not None and math.isfinite(value)), ranked=False)
