"""Whether predicted probabilities are what is seen."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

BINS = 10  # bins of equal width over [0, 1]


class Bin(NamedTuple):
    """The rows whose predicted probability lies in one bin."""

    predicted: float  # their mean predicted probability; NaN where there are none
    seen: float  # the share of them with the event; NaN where there are none
    size: int


def reliability(event: NDArray[np.bool_], probability: NDArray[Any]) -> list[Bin]:
    """Sort N rows into ten bins of equal width by their predicted probability [N]; 1.0 belongs
    to the last.
    """
    index = np.minimum((probability * BINS).astype(int), BINS - 1)
    rows = []
    for number in range(BINS):
        here = index == number
        size = int(here.sum())
        rows.append(
            Bin(float(probability[here].mean()), float(event[here].mean()), size)
            if size
            else Bin(np.nan, np.nan, 0)
        )
    return rows


def calibration_error(bins: list[Bin]) -> float:
    """Return the expected calibration error: the mean |predicted - seen| over the bins,
    weighted by their rows; NaN without rows.
    """
    total = sum(row.size for row in bins)
    if not total:
        return float("nan")
    return sum(abs(row.predicted - row.seen) * row.size for row in bins if row.size) / total
