"""What a calibration reads of the values of many decisions: a quantile for a threshold, and
quantiles that describe the distribution.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

UPPER_TAIL: Mapping[str, float] = {"median": 0.5, "p90": 0.90, "p95": 0.95}
LOWER_TAIL: Mapping[str, float] = {"p05": 0.05, "p10": 0.10, "median": 0.5}


def quantile(values: Tensor, q: float) -> float:
    """Return the quantile q, from 0 to 1, of values [K]; NaN where there are none."""
    if not len(values):
        return float("nan")
    return float(torch.quantile(values, q))


def distributions(
    values: Mapping[str, Tensor], shares: Mapping[str, float] = UPPER_TAIL
) -> dict[str, float]:
    """Return quantiles of several values [K] by name, as `NAME_LABEL`.

    Args:
        values: by name.
        shares: quantiles from 0 to 1 by label.
    """
    numbers: dict[str, float] = {}
    for name, each in values.items():
        for label, q in shares.items():
            numbers[f"{name}_{label}"] = quantile(each, q)
    return numbers
