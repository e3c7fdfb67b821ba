"""What people did in the cells that they drove: who, in which place, what they answered, and how well the clock was kept.

The unit of every spread is the participant: episodes of one person are not independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.operators.registry import PERSON
from wasp_cli.report.stats.bootstrap import COVERAGE, drawn
from wasp_cli.report.stats.frame import CellNumbers, Frame, Wanted
from wasp_cli.report.stats.summary import UNDEFINED, Interval, Value
from wasp_cli.store.artifact import read_record
from wasp_cli.store.people import SESSION_FILE, TIMING_FILE, read_timing

TLX = "tlx"
WORKLOAD = "raw_tlx"
"""Mean of the six scales of NASA's task load index, without weights."""


@dataclass(frozen=True, eq=False)
class Sitting:
    """One cell that a participant drove."""

    cell: CellNumbers
    place: int | None
    """of its block in the participant's order, from 0"""
    answers: Mapping[str, float]
    """by scale; with RAW TLX, where all six were answered"""
    beats: pa.Table
    """a row per decision (`store.people.BEAT`)"""
    simulated: bool
    """a script drove"""
    cut: int
    """episodes that were given up"""
    pauses: int
    lost: int
    """lost connections"""

    @property
    def participant(self) -> int:
        """Return the number."""
        return int(self.cell.identity.value or 0)


def read_people(wanted: Sequence[Wanted], frame: Frame) -> tuple[list[Sitting], list[str]]:
    """Read what lies beside the rows of the cells that people drove.

    Returns:
        one for each cell, in the order of the frame, and what of it cannot be read.
    """
    folders = {cell.identity: cell.path.parent for cell in wanted if cell.identity.operator == PERSON}
    found, damaged = [], []
    for cell in frame.cells:
        if cell.identity in folders:
            try:
                found.append(_sitting(cell, folders[cell.identity]))
            except (StoreError, ArtifactError) as error:
                damaged.append(error.message)
            except (AttributeError, LookupError, TypeError, ValueError) as error:
                damaged.append(f"{folders[cell.identity] / SESSION_FILE} is not as wasp writes it: {error}")
    return found, damaged


def _sitting(cell: CellNumbers, folder: Path) -> Sitting:
    session = read_record(folder / SESSION_FILE)
    if session is None:
        raise StoreError(f"{folder / SESSION_FILE} is missing")
    place = session.get("block")
    return Sitting(
        cell, None if place is None else int(place), _answers(session.get("answers", {})), read_timing(folder / TIMING_FILE),
        bool(session.get("simulated", False)), len(session["cut"]), sum(int(each.get("pauses", 0)) for each in session["sittings"]),
        int(session.get("lost_connection", 0)),
    )  # fmt: skip


def _answers(given: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """By scale, with the mean of the six of the task load index where all of them were answered."""
    found = {scale: float(value) for scales in given.values() for scale, value in scales.items()}
    tlx = [float(value) for value in given.get(TLX, {}).values()]
    return ({WORKLOAD: float(np.mean(tlx))} if len(tlx) == 6 else {}) | found


def over_participants(numbers: Iterable[tuple[int, float]]) -> Value:
    """Return the mean over participants of their means, its standard deviation over them, and an interval.

    The interval is one of percentiles: of bootstrap means over participants (`stats.bootstrap`).

    Args:
        numbers: (participant, number); NaN does not count.
    """
    own: dict[int, list[float]] = {}
    for participant, number in numbers:
        if not math.isnan(number):
            own.setdefault(participant, []).append(number)
    if not own:
        return UNDEFINED
    means = np.array([np.mean(own[participant]) for participant in sorted(own)])
    count = len(means)
    if count == 1:
        return Value(float(means[0]), n=1, ranked=False)
    low, high = np.quantile(drawn(count) @ means / count, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    interval = Interval(round(float(low), 12) + 0.0, round(float(high), 12) + 0.0, "participant", count)
    return Value(float(means.mean()), float(means.std(ddof=1)), count, ranked=False, interval=interval)


def measured(sitting: Sitting, key: str) -> float:
    """Return a pooled column of a cell, or an answer; NaN where there is none."""
    return float(sitting.answers[key]) if key in sitting.answers else float(sitting.cell.pooled.get(key, math.nan))


def compared(own: Sequence[Sitting], reference: Sequence[Sitting], key: str) -> Value:
    """Return the mean over participants of their differences to a reference condition on the same task and seed."""
    other = {(each.participant, each.cell.identity.seed): measured(each, key) for each in reference}
    pairs = [(each.participant, measured(each, key) - other.get((each.participant, each.cell.identity.seed), math.nan)) for each in own]
    return over_participants(pairs)


def deviations(sittings: Sequence[Sitting], key: str) -> list[tuple[Sitting, float]]:
    """Return each cell's difference to the mean of its condition on its task, so that places can be compared: NaN where undefined."""
    conditions: dict[tuple[str, str, str], list[float]] = {}
    for each in sittings:
        number = measured(each, key)
        if not math.isnan(number):
            conditions.setdefault(condition_of(each), []).append(number)
    return [(each, measured(each, key) - float(np.mean(conditions.get(condition_of(each), [math.nan])))) for each in sittings]


def condition_of(sitting: Sitting) -> tuple[str, str, str]:
    """Return task, method and ablation."""
    identity = sitting.cell.identity
    return identity.task, identity.method, identity.variant
