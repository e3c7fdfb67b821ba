"""Sums over sliding windows within episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def sums_ahead(values: NDArray[Any], episode: NDArray[Any], width: int) -> NDArray[np.float64]:
    """Return the sums [K] of the `width` values that begin with each; NaN where the episode has
    fewer left.

    Args:
        values: [K].
        episode: [K] number of each value's episode, in ascending order.
        width: at least 1.
    """
    ahead = np.full(len(values), np.nan)
    if len(values) < width:
        return ahead
    sums = np.convolve(values.astype(np.float64), np.ones(width), "valid")
    within = episode[width - 1 :] == episode[: len(sums)]  # the window ends in the same episode
    ahead[: len(sums)][within] = sums[within]
    return ahead
