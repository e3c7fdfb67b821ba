"""Sums over sliding windows within episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def sums_ahead(values: NDArray[Any], episode: NDArray[Any], width: int) -> NDArray[np.float64]:
    """Return the sums [K] of the `width` values that begin with each; NaN where the episode has
    fewer left. `episode` [K] is sorted.
    """
    ahead = np.full(len(values), np.nan)
    if len(values) >= width:
        sums = np.convolve(values.astype(np.float64), np.ones(width), "valid")
        whole = episode[width - 1 :] == episode[: len(sums)]
        ahead[: len(sums)][whole] = sums[whole]
    return ahead
