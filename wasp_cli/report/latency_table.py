"""How long a decision takes: table `latency`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wasp_cli.report.frame import TIMES, Floats, Frame
from wasp_cli.report.main_table import full_groups, labels_of
from wasp_cli.report.statistics import over_episodes
from wasp_cli.report.table import Column, Row, Table

COLUMNS = tuple(
    Column(f"{name}.{over}", f"{share}, {over}", digits=2)
    for name, share in zip(TIMES, ("p50", "p95"), strict=True)
    for over in ("median", "worst")
)
REDUCE: dict[str, Callable[[Floats], float]] = {"median": np.median, "worst": np.max}


def latency_table(frame: Frame) -> Table | None:
    """Per task and method the median and 95th percentile of the time of a decision, in milliseconds; None where nothing has been timed."""
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
    return Table("latency", "Time of a decision (ms)", ("Task", "Method"), COLUMNS, tuple(rows), meanings=meanings, ranked=False)
