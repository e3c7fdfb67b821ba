"""Whether predicted probabilities agree with the frequencies of events."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

BINS = 10  # bins of equal width over [0, 1]


class Bin(NamedTuple):
    """The rows whose predicted probability lies in one bin."""

    predicted: float  # their mean predicted probability; NaN where there are none
    seen: float  # the share of them with the event; NaN where there are none
    size: int  # number of rows


def reliability(event: NDArray[np.bool_], probability: NDArray[Any]) -> list[Bin]:
    """Sort N rows into ten bins of equal width by their predicted probability [N]; 1.0 belongs
    to the last bin. `event` [N] says where the event happened.
    """
    index = np.minimum((probability * BINS).astype(int), BINS - 1)
    bins = []
    for number in range(BINS):
        here = index == number
        size = int(here.sum())
        if size:
            bins.append(Bin(float(probability[here].mean()), float(event[here].mean()), size))
        else:
            bins.append(Bin(np.nan, np.nan, 0))
    return bins


def calibration_error(bins: list[Bin]) -> float:
    """Return the expected calibration error: the mean |predicted - seen| over the bins,
    weighted by their rows; NaN without rows.
    """
    filled = [each for each in bins if each.size]
    total = sum(each.size for each in filled)
    if not total:
        return float("nan")
    return sum(abs(each.predicted - each.seen) * each.size for each in filled) / total
