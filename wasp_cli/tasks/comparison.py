"""How a quantity is compared with a recording of the reference package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Recording = Mapping[str, NDArray[Any]]


class Check(NamedTuple):
    """One compared quantity."""

    quantity: str
    worst: float
    """Largest absolute error (nan when there is nothing finite to compare)."""
    tolerance: float
    compared: int
    """Number of entries compared."""

    @property
    def ok(self) -> bool:
        return self.compared > 0 and self.worst <= self.tolerance


def compare(quantity: str, ours: Any, theirs: Any, tolerance: float) -> Check:
    """The worst absolute difference of two arrays of one shape."""
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    if ours.shape != theirs.shape:
        raise ValueError(f"{quantity}: shapes {ours.shape} and {theirs.shape} differ")
    return Check(quantity, float(np.abs(ours - theirs).max()) if ours.size else float("nan"), tolerance, ours.size)
