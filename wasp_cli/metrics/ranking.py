"""Ranking quality of a score for a rare event, and correlation of a score with a value.

Dimension letters: N rows, R resamples, K clusters, T distinct thresholds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


def average_precision(event: NDArray[np.bool_], score: NDArray[Any]) -> float:
    """Return the area under the precision-recall curve of scores [N] for events [N] as the step sum
    over distinct thresholds; NaN without any event.

    Ties share a threshold, so a constant score has the base rate.
    """
    positives = int(event.sum())
    if positives == 0:
        return float("nan")
    order = np.argsort(-score, kind="stable")
    # Only the last entry of a run of equal scores is a threshold.
    last = np.append(np.diff(score[order]) != 0, True)
    hits = np.cumsum(event[order])[last]  # [T] events above each threshold
    count = np.flatnonzero(last) + 1  # [T] rows above it
    precision = hits / count
    recall = hits / positives
    return float(np.sum(np.diff(recall, prepend=0.0) * precision))


def recall_at(event: NDArray[np.bool_], score: NDArray[Any], false_alarms: float = 0.1) -> float:
    """Return the largest share of the events [N] that a threshold on `score` [N] finds within the
    allowed false alarms; NaN without events.

    A false alarm is a row without an event above the threshold; `false_alarms` is their largest
    share of the rows without an event. Ties share a threshold, so a constant score finds nothing.
    """
    positives = int(event.sum())
    if positives == 0:
        return float("nan")
    order = np.argsort(-score, kind="stable")
    last = np.append(np.diff(score[order]) != 0, True)
    hits = np.cumsum(event[order])[last]  # [T] events above each threshold
    alarms = np.flatnonzero(last) + 1 - hits  # [T] other rows above it
    allowed = hits[alarms <= false_alarms * (len(event) - positives)]
    if not len(allowed):
        return 0.0
    return float(allowed[-1]) / positives


def average_precision_interval(
    event: NDArray[np.bool_],
    score: NDArray[Any],
    cluster: NDArray[Any],
    *,
    resamples: int = 1000,
    share: float = 0.95,
    seed: int = 0,
) -> tuple[float, float]:
    """Return the percentile interval of `average_precision` over resampled clusters (whole
    episodes); NaN with fewer than two clusters.

    Rows of one episode resemble each other, so that thousands of rows may hold little information.

    Args:
        event: [N].
        score: [N].
        cluster: [N] the episode of each row.
        resamples: R draws of as many clusters as there are, with replacement.
        share: of the resamples that lie within the interval.
        seed: of the draws.
    """
    values = average_precision_resampled(event, score, cluster, resamples=resamples, seed=seed)
    return percentiles(values, share)


def average_precision_resampled(
    event: NDArray[np.bool_],
    score: NDArray[Any],
    cluster: NDArray[Any],
    *,
    resamples: int = 1000,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Return `average_precision` [R] on resampled clusters; empty where there are fewer than two
    clusters.

    The draws depend on the clusters and the seed alone, so that two scores can be compared draw by
    draw. Resamples without any event are left out. Arguments as in `average_precision_interval`.
    """
    place, drawn = cluster_draws(cluster, resamples, seed)
    if not len(drawn):
        return np.zeros(0)
    order = np.argsort(-score, kind="stable")
    last = np.append(np.diff(score[order]) != 0, True)
    weight = drawn[:, place[order]]  # [R, N] how often each row is drawn
    hits = np.cumsum(weight * event[order], 1)[:, last]  # [R, T] events above each threshold
    count = np.cumsum(weight, 1)[:, last]  # [R, T] rows above it
    steps = np.diff(hits, axis=1, prepend=0) * hits / np.maximum(count, 1)
    with_events = hits[:, -1] > 0
    values: NDArray[np.float64] = steps[with_events].sum(1) / hits[with_events, -1]
    return values


def cluster_draws(
    cluster: NDArray[Any], resamples: int, seed: int = 0
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Draw as many clusters as there are, with replacement.

    Args:
        cluster: [N] name or number of each row's cluster.
        resamples: R.
        seed: of the draws.

    Returns:
        The number [N] of each row's cluster, from 0 on; and how often each cluster is drawn [R, K],
        [0, K] of fewer than two.
    """
    _, place = np.unique(cluster, return_inverse=True)
    clusters = int(place.max()) + 1 if len(place) else 0
    if clusters < 2:
        return place, np.zeros((0, clusters), np.int64)
    shares = np.full(clusters, 1.0 / clusters)
    drawn = np.random.default_rng(seed).multinomial(clusters, shares, resamples)
    return place, drawn


class Correlations(NamedTuple):
    """Correlations of a score with a value, over all rows and on resampled clusters."""

    pearson: float
    rank: float
    # [R, 2] both of them; [0, 2] where there are fewer than two clusters
    resampled: NDArray[np.float64]


def correlations(
    score: NDArray[Any],
    value: NDArray[Any],
    cluster: NDArray[Any],
    *,
    resamples: int = 1000,
    seed: int = 0,
) -> Correlations:
    """Correlate a score [N] with a value [N], as numbers and by ranks; NaN where either does not
    vary.

    The draws depend on the clusters and the seed alone, so that two scores can be compared draw by
    draw.

    Args:
        score: [N].
        value: [N].
        cluster: [N] the episode of each row.
        resamples: R draws of as many clusters as there are, with replacement.
        seed: of the draws.
    """
    place, drawn = cluster_draws(cluster, resamples, seed)
    scores = _Weighted(score)
    values = _Weighted(value)

    def both(weight: NDArray[np.float64]) -> tuple[float, float]:
        """Return the correlations of numbers and of ranks if rows weigh `weight` [N]."""
        pearson = _pearson(scores.values, values.values, weight)
        rank = _pearson(scores.ranks(weight), values.ranks(weight), weight)
        return pearson, rank

    pearson, rank = both(np.ones(len(place)))
    resampled = [both(row[place].astype(np.float64)) for row in drawn]
    return Correlations(pearson, rank, np.array(resampled).reshape(-1, 2))


class _Weighted:
    """Values [N] that are sorted once, for their ranks under any weights. Ties have their average
    rank: costs have many at zero.
    """

    def __init__(self, values: NDArray[Any]) -> None:
        self.values = np.asarray(values, np.float64)
        _, self._place = np.unique(self.values, return_inverse=True)

    def ranks(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the average rank [N] of every value if each row is there `weight` [N] times."""
        counts = np.bincount(self._place, weight)
        average: NDArray[np.float64] = (np.cumsum(counts) - (counts - 1) / 2)[self._place]
        return average


def _pearson(a: NDArray[np.float64], b: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Return the correlation of a [N] and b [N] under weights [N]; NaN where either does not
    vary.
    """
    total = weight.sum()
    if not total:
        return float("nan")
    a = a - (weight @ a) / total
    b = b - (weight @ b) / total
    spread = (weight @ a**2) * (weight @ b**2)
    if not spread > 0:
        return float("nan")
    return float(weight @ (a * b) / np.sqrt(spread))


def percentiles(values: NDArray[np.float64], share: float = 0.95) -> tuple[float, float]:
    """Return the interval in which the middle `share` of the values [N] lies; NaN where there are
    none.
    """
    if not len(values):
        return float("nan"), float("nan")
    low, high = np.quantile(values, [(1 - share) / 2, (1 + share) / 2])
    return float(low), float(high)
