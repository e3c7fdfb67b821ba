"""Sums over sliding windows within episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def window_sums(values: NDArray[Any], episode: NDArray[Any], width: int) -> NDArray[np.float64]:
    """Sums of `width` consecutive values [K] that lie in one episode; `episode` [K] is sorted."""
    if len(values) < width:
        return np.zeros(0)
    sums = np.convolve(values.astype(np.float64), np.ones(width), "valid")
    whole: NDArray[np.float64] = sums[episode[width - 1 :] == episode[: len(sums)]]
    return whole
