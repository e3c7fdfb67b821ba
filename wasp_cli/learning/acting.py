"""Whether an expert acts by the mode of its policy or by the mean of what it executed.

PPO learns with exploration, and an expert acts without it. Where the exploration is still wide at
the end of a training, many draws were cut at the bounds, and the mode is not what was learned with.
Which way is better is a matter of the environment, so it is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.learning.privileged import EpisodeSums
from wasp_cli.models.policy import Acts

CLEAR = 2.0
"""Standard errors of a mean difference beyond which one way is better."""
Numbers = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences, and its standard error."""

    mean: float
    error: float

    @classmethod
    def of(cls, ours: Numbers, others: Numbers) -> Difference:
        """Return ours minus others, [B] each in the same worlds; B is at least 2."""
        differences = np.asarray(ours, float) - np.asarray(others, float)
        error = differences.std(ddof=1) / np.sqrt(len(differences))
        return cls(float(differences.mean()), float(error))


def better_acting(by_mode: EpisodeSums, by_mean: EpisodeSums) -> Acts:
    """Return how a policy acts better, from episodes in the same worlds.

    It is the mode, unless the mean returns more or costs less by more than two standard errors, and
    is worse in neither by more than one. With a single world it is the mode.
    """
    if len(by_mode.returns) < 2:
        return "mode"
    gain = Difference.of(by_mean.returns, by_mode.returns)
    saved = Difference.of(by_mode.costs, by_mean.costs)
    for each in (gain, saved):
        if each.mean < -each.error:
            return "mode"
    clear = any(each.mean > CLEAR * each.error for each in (gain, saved))
    return "mean" if clear else "mode"
