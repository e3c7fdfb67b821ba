"""Whether predicted gains come true: what a model predicted that interventions would gain, beside
what they gained.

A gain is the difference of two futures from one state, with the intervention and without it. The
prediction is the model's (`store.tables.STEP`: plan against command alone, on the same rollouts),
the truth that of the paired branches of the real task (`metrics.necessity`). `discounted` makes
them comparable. These differences remain:

- The model's futures follow the expert after the correction (`wasp`), or the operator's own rule
  (`printed`). The branches follow the operator, mistakes and all.
- A predicted return has a value function behind the horizon H. The branches end after W decisions,
  so that later gains are predicted and not observed.
- Where a plan has several corrections, the prediction is that of all of them, and the branch
  executes the first one.
- Interventions are those that a gate let through. What the model predicts of others is not tested.

Dimension letters: N interventions, W decisions of a branch, R resamples, K clusters, C sets of
interventions. Rows of one cluster (a world) resemble each other, so that intervals are percentiles
over resampled clusters.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.metrics.ranking import cluster_draws, correlations, percentiles

Floats = NDArray[np.float64]

BINS = 5  # largest number of bins
LEAST = 10  # fewest interventions of a bin, if there are several bins
CLUSTERS = 6
"""Fewest clusters from which `holds_from` concludes. Without any gain five of five means are above
0 in one case of 32, and the bootstrap of five positive numbers is above 0 as well.
"""
RESAMPLES = 1000
BLOCK = 256  # predicted gains that are tested together: all of them may need too much memory


class Interval(NamedTuple):
    """The middle 95 % of the resamples; NaN where there are fewer than two clusters."""

    low: float
    high: float


class GainBin(NamedTuple):
    """Interventions whose predicted gains are neighbours."""

    predicted: float  # mean
    realised: float  # mean
    interval: Interval  # of the realised mean
    size: int  # number of interventions


class Flatness(NamedTuple):
    """How realised gains follow predicted ones. Both numbers are 0 where realised gains do not
    depend on predicted ones, and NaN where predictions do not vary.
    """

    slope: float  # least squares of realised on predicted gain; 1 where predictions come true
    slope_interval: Interval
    rank: float  # rank correlation
    rank_interval: Interval


def discounted(values: NDArray[Any], gamma: float) -> Floats:
    """Return the sums [N] of `values` [N, W], the k-th of which counts gamma ** k from 0 on, as in
    a predicted return.
    """
    terms = np.asarray(values, np.float64)
    weights = gamma ** np.arange(terms.shape[1])
    total: Floats = terms @ weights
    return total


def gain_bins(
    predicted: Floats,
    realised: Floats,
    cluster: NDArray[Any],
    *,
    bins: int = BINS,
    least: int = LEAST,
    resamples: int = RESAMPLES,
) -> list[GainBin]:
    """Sort interventions into bins of about equally many by their predicted gain.

    Equal predictions stay together. There are fewer bins than asked for where they would have fewer
    than `least` interventions.

    Args:
        predicted: [N].
        realised: [N].
        cluster: [N] the world of each.
        bins: largest number of bins.
        least: fewest interventions of a bin.
        resamples: of the clusters.

    Returns:
        The bins from the smallest predicted gain to the largest; none without interventions.
    """
    if not len(predicted):
        return []
    number = max(1, min(bins, len(predicted) // least))
    edges = np.quantile(predicted, np.arange(1, number) / number)
    index = np.searchsorted(edges, predicted, side="left")
    gain_bins = []
    for place in np.unique(index):
        here = index == place
        gain_bin = GainBin(
            predicted=float(predicted[here].mean()),
            realised=float(realised[here].mean()),
            interval=mean_interval(realised[here], cluster[here], resamples=resamples),
            size=int(here.sum()),
        )
        gain_bins.append(gain_bin)
    return gain_bins


def mean_interval(values: Floats, cluster: NDArray[Any], *, resamples: int = RESAMPLES) -> Interval:
    """Return the interval of the mean of `values` [N] over resampled clusters [N]."""
    place, drawn = cluster_draws(cluster, resamples)
    if not len(drawn):  # a single cluster
        return Interval(math.nan, math.nan)
    totals = np.bincount(place, values)
    sizes = np.bincount(place)
    return Interval(*percentiles((drawn @ totals) / (drawn @ sizes)))


def flatness(
    predicted: Floats, realised: Floats, cluster: NDArray[Any], *, resamples: int = RESAMPLES
) -> Flatness:
    """Return how realised gains [N] follow predicted ones [N]; resamples in which predictions do
    not vary are left out.
    """
    correlation = correlations(predicted, realised, cluster, resamples=resamples)
    ranks = correlation.resampled[:, 1]
    place, drawn = cluster_draws(cluster, resamples)
    slopes = _slopes(predicted, realised, place, drawn.astype(np.float64))
    slope = _slopes(predicted, realised, place, np.ones((1, drawn.shape[1])))
    return Flatness(
        slope=float(slope[0]) if len(slope) else math.nan,
        slope_interval=Interval(*percentiles(slopes[~np.isnan(slopes)])),
        rank=correlation.rank,
        rank_interval=Interval(*percentiles(ranks[~np.isnan(ranks)])),
    )


def _slopes(x: Floats, y: Floats, place: NDArray[np.int64], drawn: Floats) -> Floats:
    """Return the slopes [R] of y [N] on x [N]; NaN where x does not vary.

    Args:
        x: [N].
        y: [N].
        place: [N] the number of each row's cluster.
        drawn: [R, K] how often each cluster counts.
    """
    if not len(x):
        return np.zeros(0)
    # Without their means, since rounding of large squares would hide a small variation.
    x = x - x.mean()
    y = y - y.mean()

    def total(values: Floats) -> Floats:
        """Return the sums [R] of values [N] over the rows of each resample."""
        sums: Floats = drawn @ np.bincount(place, values, drawn.shape[1])
        return sums

    size = total(np.ones(len(x)))
    sum_x = total(x)
    sum_y = total(y)
    sum_xx = total(x * x)
    sum_xy = total(x * y)
    spread = sum_xx - sum_x**2 / size
    together = sum_xy - sum_x * sum_y / size
    varies = spread > 1e-12 * sum_xx
    slopes: Floats = np.divide(together, spread, out=np.full(len(drawn), np.nan), where=varies)
    return slopes


def holds_from(
    predicted: Floats,
    realised: Floats,
    cluster: NDArray[Any],
    *,
    clusters: int = CLUSTERS,
    resamples: int = RESAMPLES,
) -> float | None:
    """Return the smallest predicted gain from which on predictions hold: the interventions that
    were predicted to gain at least as much did gain something.

    That is, the interval of their mean realised gain lies above 0. It is a mean: those with the
    smallest predicted gains need not have gained anything. Every predicted gain is a candidate, and
    some of so many hold by chance.

    Args:
        predicted: [N].
        realised: [N].
        cluster: [N] the world of each.
        clusters: fewest clusters in which these interventions have to be.
        resamples: of all clusters; those without any of these interventions are left out.

    Returns:
        One of the predicted gains; None where predictions hold from none of them.
    """
    order = np.argsort(predicted, kind="stable")
    predicted = predicted[order]
    realised = realised[order]
    place, drawn = cluster_draws(cluster[order], resamples)
    rows = np.arange(len(predicted))

    # The sum of each cluster's gains from a row on, and the number of its interventions, [N, K].
    gains = np.zeros((len(rows), drawn.shape[1]))
    sizes = np.zeros((len(rows), drawn.shape[1]))
    gains[rows, place] = realised
    sizes[rows, place] = 1.0
    gains = np.cumsum(gains[::-1], 0)[::-1]
    sizes = np.cumsum(sizes[::-1], 0)[::-1]
    enough = (sizes > 0).sum(1) >= clusters

    # From the smallest predicted gain on, a block at a time.
    candidates = np.flatnonzero((np.diff(predicted, prepend=-np.inf) > 0) & enough)
    for block in np.split(candidates, range(BLOCK, len(candidates), BLOCK)):
        for start, means in zip(block, _means(drawn, gains[block], sizes[block]), strict=True):
            low, _ = percentiles(means[~np.isnan(means)])
            # The last bits of a sum differ between machines.
            if round(low, 12) > 0.0:
                return float(predicted[start])
    return None


def _means(drawn: NDArray[np.int64], totals: Floats, sizes: Floats) -> Floats:
    """Return the means [C, R] of C sets of interventions; NaN where none of a set is drawn.

    Args:
        drawn: [R, K] how often each cluster counts.
        totals: [C, K] sums of the gains of a set in each cluster.
        sizes: [C, K] numbers of its interventions.
    """
    total = totals @ drawn.T
    size = sizes @ drawn.T
    means: Floats = np.divide(total, size, out=np.full(total.shape, np.nan), where=size > 0)
    return means
