"""Ranking quality of a score for a rare event, and correlation of a score with a value."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


def average_precision(event: NDArray[np.bool_], score: NDArray[Any]) -> float:
    """Return the area under the precision-recall curve of N scores [N] as the step sum over
    distinct thresholds; NaN without any event.

    Ties share a threshold, so a constant score has the base rate.
    """
    positives = int(event.sum())
    if positives == 0:
        return float("nan")
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(event[order])
    # Only the last entry of a run of equal scores is a threshold.
    last = np.append(np.diff(score[order]) != 0, True)
    found, count = hits[last], np.flatnonzero(last) + 1
    precision = found / count
    recall = found / positives
    return float(np.sum(np.diff(recall, prepend=0.0) * precision))


def recall_at(event: NDArray[np.bool_], score: NDArray[Any], false_alarms: float = 0.1) -> float:
    """Return the largest share of the events [N] that a threshold on `score` [N] finds within the
    allowed false alarms; NaN without events.

    A false alarm is another row above the threshold, counted as a share of these rows.

    Ties share a threshold, so a constant score finds nothing.
    """
    positives = int(event.sum())
    if positives == 0:
        return float("nan")
    order = np.argsort(-score, kind="stable")
    last = np.append(np.diff(score[order]) != 0, True)
    hits = np.cumsum(event[order])[last]
    alarms = np.flatnonzero(last) + 1 - hits
    allowed = hits[alarms <= false_alarms * (len(event) - positives)]
    return float(allowed[-1]) / positives if len(allowed) else 0.0


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
    episodes); NaN of fewer than two clusters.

    Rows of one episode resemble each other, so that thousands of rows may say little.

    Args:
        event: [N].
        score: [N].
        cluster: [N] the episode of each row.
        resamples: draws of as many clusters as there are, with replacement.
        share: of the resamples that lie within the interval.
    """
    return percentiles(
        average_precision_resampled(event, score, cluster, resamples=resamples, seed=seed), share
    )


def average_precision_resampled(
    event: NDArray[np.bool_],
    score: NDArray[Any],
    cluster: NDArray[Any],
    *,
    resamples: int = 1000,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Return `average_precision` [resamples] on resampled clusters; empty where fewer than two
    clusters are there.

    The draws depend on the clusters and the seed alone, so that two scores can be compared draw by
    draw. Resamples without any event say nothing and are left out. Arguments as in
    `average_precision_interval`.
    """
    place, drawn = cluster_draws(cluster, resamples, seed)
    if not len(drawn):
        return np.zeros(0)
    order = np.argsort(-score, kind="stable")
    last = np.append(np.diff(score[order]) != 0, True)
    weight = drawn[:, place[order]]  # [R, N] how often each row is drawn
    hits = np.cumsum(weight * event[order], 1)[:, last]
    count = np.cumsum(weight, 1)[:, last]
    found = np.diff(hits, axis=1, prepend=0) * hits / np.maximum(count, 1)
    with_events = hits[:, -1] > 0
    values: NDArray[np.float64] = found[with_events].sum(1) / hits[with_events, -1]
    return values


def cluster_draws(
    cluster: NDArray[Any], resamples: int, seed: int = 0
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Draw as many clusters as there are, with replacement.

    Returns:
        The number [N] of each row's cluster, and how often each cluster is drawn [resamples,
        clusters]; [0, clusters] of fewer than two.
    """
    _, place = np.unique(cluster, return_inverse=True)
    clusters = int(place.max()) + 1 if len(place) else 0
    if clusters < 2:
        return place, np.zeros((0, clusters), np.int64)
    return place, np.random.default_rng(seed).multinomial(
        clusters, np.full(clusters, 1.0 / clusters), resamples
    )


class Correlations(NamedTuple):
    """Of a score with a value, on the rows there are and on resampled clusters."""

    pearson: float
    rank: float
    # [resamples, 2] both of them; empty where fewer than two clusters are there
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
        resamples: draws of as many clusters as there are, with replacement.
    """
    place, drawn = cluster_draws(cluster, resamples, seed)
    pairs = [_Weighted(score), _Weighted(value)]

    def both(weight: NDArray[np.float64]) -> tuple[float, float]:
        a, b = pairs
        return _pearson(a.values, b.values, weight), _pearson(
            a.ranks(weight), b.ranks(weight), weight
        )

    found = both(np.ones(len(place)))
    return Correlations(
        *found, np.array([both(row[place].astype(np.float64)) for row in drawn]).reshape(-1, 2)
    )


class _Weighted:
    """Values [N] whose ranks under weights need no further sorting; ties have their average
    rank, and costs have many at zero.
    """

    def __init__(self, values: NDArray[Any]) -> None:
        self.values = np.asarray(values, np.float64)
        _, self._place = np.unique(self.values, return_inverse=True)

    def ranks(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the average rank [N] of every value where each row is there `weight` [N] times."""
        counts = np.bincount(self._place, weight)
        average: NDArray[np.float64] = (np.cumsum(counts) - (counts - 1) / 2)[self._place]
        return average


def _pearson(a: NDArray[np.float64], b: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    total = weight.sum()
    if not total:
        return float("nan")
    a, b = a - (weight @ a) / total, b - (weight @ b) / total
    spread = (weight @ a**2) * (weight @ b**2)
    return float(weight @ (a * b) / np.sqrt(spread)) if spread > 0 else float("nan")


def percentiles(values: NDArray[np.float64], share: float = 0.95) -> tuple[float, float]:
    """Return the interval in which the middle `share` of the values [N] lies; NaN of nothing."""
    if not len(values):
        return float("nan"), float("nan")
    low, high = np.quantile(values, [(1 - share) / 2, (1 + share) / 2])
    return float(low), float(high)
