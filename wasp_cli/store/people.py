"""What the cell of a person has beside its rows: what the clock and the connection were like, and
what the session was.

_timing.pq      a row per decision: BEAT
_session.json   who drove when, how fast, what was shown, pauses, episodes that were cut, answers
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from wasp_cli.store.layout import SESSION_FILE as SESSION_FILE
from wasp_cli.store.parquet import opened_table

TIMING_FILE = "_timing.pq"
VERSION_KEY, VERSION = b"wasp.timing", 1
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
    inputs, episodes = np.asarray(beats["input"]), np.asarray(beats["episode"])
    fresh = (
        np.concatenate([[False], (inputs[1:] != inputs[:-1]) & (episodes[1:] == episodes[:-1])])
        if len(late)
        else late
    )
    for name in ("decision_ms", "behind_ms", "input_age_ms", "round_trip_ms"):
        values = np.asarray(beats[name], np.float64)  # what is unknown is NaN
        if name == "input_age_ms":
            values = values[fresh]
        for label, value in zip(("p50", "p99"), percentiles(values.tolist()), strict=True):
            summary[f"{name[:-3]}_{label}_ms"] = None if value != value else round(value, 1)
    return summary


def percentiles(values: Sequence[float]) -> tuple[float, float]:
    """Return the median and the 99th percentile; NaN of nothing."""
    known = [value for value in values if value == value]
    return (
        (float(np.median(known)), float(np.percentile(known, 99)))
        if known
        else (float("nan"), float("nan"))
    )
