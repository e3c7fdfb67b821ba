"""A threshold of a gate with a guarantee by episodes, and the share that it is checked with.

Decisions of an episode are not exchangeable, episodes are. An episode's score is the lowest threshold-to-be that would still alert before
each of its costs: the minimum over its onsets of the largest signal in the W decisions up to that onset. Of n costly episodes the k-th
smallest score, k = floor(eps (n + 1)), is undercut by that of another costly episode with probability at most eps, whatever the signal
is worth (a split conformal bound on one side). T decisions of an episode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import WaspError

LEVEL = 0.95
"""Of the interval of a share."""
ROUNDING = 1e-9
"""0.29 * 100 is 28.999999999999996."""


class CoverageThreshold(NamedTuple):
    """A threshold, and what it was taken from."""

    value: float
    """The gate alerts where its signal is above it, in float32: just below the k-th smallest score, which alerts too."""
    score: float
    """The k-th smallest score."""
    n: int
    """Costly episodes."""
    k: int


def episode_score(signal: NDArray[Any], cost: NDArray[Any], window: int) -> float | None:
    """Return the score of an episode; None where nothing cost.

    Args:
        signal: [T] what the gate reads at every decision.
        cost: [T] whether the decision cost; an onset is a cost after a decision without one, or at the first.
        window: W: an onset counts as foreseen by its own decision and the W - 1 before it.
    """
    costly = np.asarray(cost) > 0
    onsets = np.flatnonzero(costly & ~np.concatenate([[False], costly[:-1]]))
    if not len(onsets):
        return None
    return float(min(np.max(signal[max(0, onset - window + 1) : onset + 1]) for onset in onsets))


def coverage_threshold(scores: Sequence[float], eps: float, episodes: int) -> CoverageThreshold:
    """Return the threshold below which a new costly episode's score lies with probability at most eps.

    Args:
        scores: of the n costly episodes.
        eps: share of costly episodes that may have an onset without an alert.
        episodes: how many there were with those that cost nothing; for the message.

    Raises:
        WaspError: n is too small for eps, so that no threshold would hold.
    """
    n, least = len(scores), math.ceil(1.0 / eps - 1.0 - ROUNDING)
    k = math.floor(eps * (n + 1) + ROUNDING)
    if k < 1:
        raise WaspError(
            f"tau_c with coverage {eps:g} needs {least} costly episodes of the operators alone, and {n} of {episodes} cost anything",
            f"set coverage.episodes to {math.ceil(1.5 * episodes * least / max(n, 1))} or more"
            + (f", or wasp.tau_c.coverage to at least {math.ceil(100 / (n + 1)) / 100:g}" if n else ""),
        )
    score = float(np.sort(np.asarray(scores, np.float64))[k - 1])
    return CoverageThreshold(float(np.nextafter(np.float32(score), np.float32(-np.inf))), score, n, k)


def clopper_pearson(hits: int, trials: int, level: float = LEVEL) -> tuple[float, float]:
    """Return the exact interval of a share: `hits` of `trials`. Without trials it is all of [0, 1]."""
    tail = (1.0 - level) / 2.0
    low = 0.0 if hits == 0 else _root(lambda p: _at_most(trials - hits, trials, 1.0 - p) - tail)
    high = 1.0 if hits == trials else _root(lambda p: tail - _at_most(hits, trials, p))
    return low, high


def _at_most(hits: int, trials: int, share: float) -> float:
    """P(X <= hits) of a binomial variable."""
    return math.fsum(math.comb(trials, i) * share**i * (1.0 - share) ** (trials - i) for i in range(hits + 1))


def _root(rising: Any) -> float:
    """Where a rising function on [0, 1] is zero."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2.0
        low, high = (middle, high) if rising(middle) < 0.0 else (low, middle)
    return (low + high) / 2.0
