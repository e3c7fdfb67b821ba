"""The thresholds that were in force, as the rows store them."""

from __future__ import annotations

import math

from wasp_cli.report.frame import CellNumbers, Frame, groups
from wasp_cli.report.statistics import over_seeds
from wasp_cli.report.table import Column, Row, Table, Value
from wasp_cli.report.titles import assistant_title, task_title

COLUMNS = (
    Column("tau_c", "tau_c", digits=3),
    Column("tau_r", "tau_r", digits=3),
    Column("tau_q", "tau_Q", digits=3),
)


def threshold_table(frame: Frame) -> Table:
    """Per task and assistant the mean threshold over seeds; without rows when no method has one."""
    rows = []
    for group in groups(frame):
        numbers = tuple(_threshold(group.cells, column.key) for column in COLUMNS)
        if any(value.mean is not None for value in numbers):
            rows.append(Row((task_title(group.task), assistant_title(group, ablation=group.assistant_variant != "full")), numbers))
    meanings = (
        "tau_c: expected costly decision steps, within the horizon (WASP) or from here on (safety filter); tau_r: return; "
        "tau_Q: IDA's advantage. The other methods have no threshold; what each was calibrated on stands under What was trained.",
    )
    return Table("thresholds", "Thresholds in force", ("Task", "Method"), COLUMNS, tuple(rows), meanings=meanings)


def _threshold(cells: tuple[CellNumbers, ...], key: str) -> Value:
    by_seed = {cell.identity.seed: getattr(cell.thresholds, key) for cell in cells}
    return over_seeds((value for value in by_seed.values() if value is not None and math.isfinite(value)), ranked=False)
