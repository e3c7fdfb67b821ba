"""What the cell of a person has beside its rows: what the clock and the connection were like, and
what the session was.

_timing.pq      a row per decision: BEAT
_session.json   who drove when, how fast, what was shown, pauses, episodes that were cut, answers
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from wasp_cli.store.layout import SESSION_FILE as SESSION_FILE
from wasp_cli.store.parquet import opened_table

TIMING_FILE = "_timing.pq"
VERSION_KEY = b"wasp.timing"
VERSION = 1
BEAT = pa.schema(
    [
        pa.field("episode", pa.int32(), nullable=False),
        pa.field("t", pa.int32(), nullable=False),
        pa.field("at", pa.float64(), nullable=False),
        pa.field("decision_ms", pa.float32(), nullable=False),
        pa.field("late", pa.bool_(), nullable=False),
        pa.field("behind_ms", pa.float32(), nullable=False),
        pa.field("rest_ms", pa.float32(), nullable=False),
        pa.field("input", pa.int32(), nullable=False),
        pa.field("input_age_ms", pa.float32()),
        pa.field("round_trip_ms", pa.float32()),
        pa.field("keys", pa.string(), nullable=False),
        pa.field("focused", pa.bool_(), nullable=False),
    ],
    {VERSION_KEY: str(VERSION).encode()},
)
"""A decision; the meaning of the fields is that of `drive.block.Beat`. What is unknown is null."""


def read_timing(path: Path) -> pa.Table:
    """Read the timing of a session: a table of BEAT. Raises StoreError."""
    with opened_table(path, VERSION_KEY, VERSION, "the timing of a session") as file:
        return file.read()


def timing_summary(beats: pa.Table) -> dict[str, Any]:
    """Summarise decisions: how many, how many late, and percentiles of delays in ms; None where
    nothing is known.

    The age of a key counts where the command was new: before that it is the time for which a key
    was held.
    """
    late = np.asarray(beats["late"], bool)
    share = round(float(late.mean()), 4) if len(late) else None
    summary: dict[str, Any] = {"decisions": len(late), "late": int(late.sum()), "late_share": share}
    # Decisions with a new command, in the same episode as the one before.
    inputs = np.asarray(beats["input"])
    episodes = np.asarray(beats["episode"])
    fresh = np.zeros(len(late), bool)
    fresh[1:] = (inputs[1:] != inputs[:-1]) & (episodes[1:] == episodes[:-1])
    for name in ("decision_ms", "behind_ms", "input_age_ms", "round_trip_ms"):
        values = np.asarray(beats[name], np.float64)  # what is unknown is NaN
        if name == "input_age_ms":
            values = values[fresh]
        median, largest = percentiles(values.tolist())
        delay = name.removesuffix("_ms")
        summary[f"{delay}_p50_ms"] = None if math.isnan(median) else round(median, 1)
        summary[f"{delay}_p99_ms"] = None if math.isnan(largest) else round(largest, 1)
    return summary


def percentiles(values: Sequence[float]) -> tuple[float, float]:
    """Return the median and the 99th percentile of the values that are not NaN; NaN where there is
    none.
    """
    numbers = [value for value in values if not math.isnan(value)]
    if not numbers:
        return math.nan, math.nan
    return float(np.median(numbers)), float(np.percentile(numbers, 99))
