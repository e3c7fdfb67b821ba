"""Vectors as a world model reads them where a task shows no image: in units of the dataset's
standard deviations, within a bound. S = size of a vector, N = rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

BOUND = 10.0
"""Standard deviations at which a value is cut: one that the dataset hardly ever had must not
outweigh all others, or overflow.
"""
CONSTANT = 1e-6
"""Standard deviation, in units of the mean where that is above 1, below which a component counts as
constant: its variation is rounding.
"""
MAGNITUDE = 500.0
"""The squared error of a vector that is decoded as the mean of all.

Eq. 6 weighs the image with the KL terms, and both depend on units. An image is a sum over 24,576
pixels: in the published datasets of the three tasks, their squared distance from the mean image is
337 to 911, and from the decoded image of a trained model 97 to 467, while the KL terms end at 17 to
20 nats. The error of a standardised vector of S components would begin at S, so that a few nats of
KL would cost more than the whole vector is worth. It is scaled to begin where that of images does;
then `beta_o`, free nats and the weights of the heads mean the same for both.
"""


class Standard(NamedTuple):
    """Mean and standard deviation of a dataset's vectors, S numbers each."""

    mean: tuple[float, ...]
    std: tuple[float, ...]  # 1 where a component is constant


def standard_of(vectors: NDArray[Any]) -> Standard:
    """Return mean and standard deviation of vectors [N, S]."""
    values = np.asarray(vectors, np.float64)
    mean = values.mean(0)
    std = values.std(0)
    varies = std > CONSTANT * np.maximum(1.0, np.abs(mean))
    return Standard(tuple(mean.tolist()), tuple(np.where(varies, std, 1.0).tolist()))


def standardised(vectors: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return vectors [..., S] in units of standard deviations, as float32 within BOUND; constant
    components are near 0. `mean` and `std` are those of the dataset, [S].
    """
    return ((vectors.to(mean.dtype) - mean) / std).clamp(-BOUND, BOUND).to(torch.float32)


def vector_errors(decoded: Tensor, true: Tensor) -> Tensor:
    """Return the squared errors [N] of decoded vectors [N, S], both standardised: MAGNITUDE times
    their mean over components.
    """
    return MAGNITUDE * F.mse_loss(decoded.float(), true, reduction="none").mean(-1)
