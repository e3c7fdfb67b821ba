"""How a quantity is compared with a recording of the reference package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.frames import wrapped

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


def path_means(path: Floats, seconds: float) -> tuple[Floats, Floats]:
    """Mean speed [A] in m/s and mean turn rate [A] in rad/s along x, y, yaw [A, T, 3], whose rows are `seconds` apart."""
    moves = np.diff(path, axis=1)
    speed: Floats = np.hypot(moves[..., 0], moves[..., 1]).mean(axis=1) / seconds
    return speed, wrapped(moves[..., 2]).mean(axis=1) / seconds


def mean_ratio(ours: Floats, theirs: Floats) -> Floats:
    """Ours / theirs [A]; next to standstill (0.02 of a unit) the absolute difference counts."""
    return 1.0 + (ours - theirs) / np.maximum(np.abs(theirs), 0.02)
