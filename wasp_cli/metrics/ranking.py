"""Ranking quality of a score for a rare event."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def average_precision(event: NDArray[np.bool_], score: NDArray[Any]) -> float:
    """Area under the precision-recall curve as the step sum over distinct thresholds; NaN without any event.

    Ties share a threshold, so a constant score has the base rate.
    """
    positives = int(event.sum())
    if positives == 0:
        return float("nan")
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(event[order])
    # Only the last entry of a run of equal scores is a threshold.
    last = np.append(np.diff(score[order]) != 0, True)
    found, count = hits[last], np.flatnonzero(last) + 1
    precision = found / count
    recall = found / positives
    return float(np.sum(np.diff(recall, prepend=0.0) * precision))


def recall_at(event: NDArray[np.bool_], score: NDArray[Any], false_alarms: float = 0.1) -> float:
    """The largest share of the events that a threshold finds while at most that share of the other rows is above it; NaN without events.

    Ties share a threshold, so a constant score finds nothing.
    """
    positives = int(event.sum())
    if positives == 0:
        return float("nan")
    order = np.argsort(-score, kind="stable")
    last = np.append(np.diff(score[order]) != 0, True)
    hits = np.cumsum(event[order])[last]
    alarms = np.flatnonzero(last) + 1 - hits
    allowed = hits[alarms <= false_alarms * (len(event) - positives)]
    return float(allowed[-1]) / positives if len(allowed) else 0.0
