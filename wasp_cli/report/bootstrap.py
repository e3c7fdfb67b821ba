"""Intervals of the numbers in a table: a seeded cluster bootstrap over trainings, or over worlds if
there is one training.

Clusters are resampled with everything in them. Episodes of one training share its models and are
not independent, so with two or more trainings the trainings are the clusters. With a single one the
worlds are the clusters, each with its episodes under all operators and, in a difference, under both
methods; rates are ratios of sums in every resample. The limits are percentiles: 95 % of RESAMPLES
resamples lie between them. With two or three clusters these are the least and the largest value,
which is called a range. The draws depend only on SEED and on the number of clusters, so the same
rows give the same interval on every machine.

Letters: R resamples, K clusters, C cells, E episodes. `cells` are those of one row of a table (one
task); a cell that does not define a column is left out of it.

A contrast has a margin: of training s it is left - right - margin x |right|, each side the mean
over conditions (operator, severity) of the column pooled over worlds; a negative margin asks for
that much less, a positive one allows or asks for that much more. It is resampled hierarchically: S
of S trainings with replacement, and for each drawn training anew as many of its worlds as it has;
with one training only worlds are drawn. Evaluation seeds that share a training's models
(`training_seed`) are one training, with the worlds of all of them. The t interval, mean -+ t(.975,
S - 1) sd / sqrt(S) of the S contrasts, shows how little a few trainings say.

    estimate = difference_of(wasp.cells, human.cells, "cost")
    estimate.value, estimate.interval       -21.4, Interval(low=-26.0, high=-15.8, unit="training",
    clusters=3)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.table import CellTable, Floats, Places, condition, paired
from wasp_cli.report.intervals import remembered
from wasp_cli.report.summary import Interval, even, paired_difference, summarise

Limits = tuple[float, float]

RESAMPLES = 2000
# of all draws. Any number would do; changing it changes the last digits of every interval.
SEED = 20211105
COVERAGE = 0.95
TRIMMED = 0.25  # share of the cells that the interquartile mean cuts off on either side


@dataclass(frozen=True)
class Estimate:
    """A number with its interval; None where there is a single cluster."""

    value: float
    interval: Interval | None


def _plain_estimate(plain: list[Any]) -> Estimate:
    value, interval = plain
    return Estimate(value, None if interval is None else Interval(*interval))


_remembered_estimate = remembered(astuple, _plain_estimate)


@dataclass(frozen=True, eq=False)
class _Clusters:
    unit: Literal["training", "world"]
    names: Floats  # [K] the seeds of the trainings, or of the worlds
    # whether they differ by chance alone: trainings with cells under other conditions do not
    alike: bool = True

    @classmethod
    def of(cls, cells: CellTable, other: CellTable | None = None) -> _Clusters:
        """The trainings of cells where there are several, else their worlds and those of others."""
        trainings = np.unique(cells.trainings).astype(np.float64)
        if len(trainings) > 1:
            return cls("training", trainings, even(cells))
        worlds = cells.worlds
        if other is not None:
            worlds = np.concatenate([worlds, other.worlds])
        return cls("world", np.unique(worlds))

    def place(self, names: Floats | Places) -> Places:
        """Return the index of the cluster of each name."""
        return np.searchsorted(self.names, names)

    def trainings(self, cells: CellTable) -> Places:
        """[C] the index of the training of each cell."""
        return self.place(cells.trainings)

    def estimate(self, value: float, statistic: Callable[[Floats], Floats]) -> Estimate:
        """A number with the interval of `statistic`: how often each cluster was drawn [R, K] ->
        [R], NaN where it is undefined.
        """
        if len(self.names) < 2 or not self.alike:
            return Estimate(value, None)
        limits = limits_of(statistic(drawn(len(self.names))))
        return Estimate(
            value, None if limits is None else Interval(*limits, self.unit, len(self.names))
        )

    def found(self, statistic: Callable[[Floats], Floats]) -> Estimate:
        """`statistic` with every cluster drawn once, and its interval."""
        return self.estimate(float(statistic(np.ones((1, len(self.names))))[0]), statistic)


def limits_of(resampled: Floats) -> Limits | None:
    """Return the percentiles between which COVERAGE of the resamples [R] lie. NaN does not count;
    without any number they are None.

    Limits are rounded to twelve decimals.
    """
    resampled = resampled[~np.isnan(resampled)]
    if not len(resampled):
        return None
    low, high = np.quantile(resampled, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    # Rounded, since the last bits of a sum differ between machines and could decide whether 0 lies
    # within an interval. Adding 0.0 turns -0.0 into 0.0.
    return round(float(low), 12) + 0.0, round(float(high), 12) + 0.0


@lru_cache(maxsize=8)
def drawn(clusters: int) -> Floats:
    """Return [R, K]: how often each of K clusters occurs in each resample of K. The array is
    shared; do not write into it.
    """
    return _times_drawn(np.random.PCG64(SEED), clusters)


def _picks(draws: np.random.PCG64, bound: int, columns: int) -> Places:
    """[R, columns] whole numbers below a bound, from the raw stream, which is the same in every
    version of NumPy.
    """
    bits = draws.random_raw((RESAMPLES, columns)) >> np.uint64(32)
    return ((bits * np.uint64(bound)) >> np.uint64(32)).astype(np.intp)


def _times_drawn(draws: np.random.PCG64, many: int) -> Floats:
    """[R, many] how often each of so many is drawn, when as many are drawn with replacement."""
    rows = np.arange(RESAMPLES)[:, None] * many
    counts = np.bincount((rows + _picks(draws, many, many)).ravel(), minlength=RESAMPLES * many)
    return counts.reshape(RESAMPLES, many).astype(np.float64)


@_remembered_estimate
def mean_of(cells: CellTable, key: str) -> Estimate | None:
    """Return the mean over seeds of the means of pooled cells, as tables print it (`summarise`);
    None if no cell defines the column.
    """
    defined = cells.defining(key)
    value = summarise(defined, key).mean
    if value is None:
        return None
    clusters = _Clusters.of(defined)

    def statistic(counts: Floats) -> Floats:
        return _mean(clusters, counts, defined, _pooled(clusters, counts, defined, key))

    return clusters.estimate(value, statistic)


@_remembered_estimate
def iqm_of(cells: CellTable, key: str) -> Estimate | None:
    """Return the interquartile mean over the cells of a row: the mean of the middle half of the
    sorted pooled cells.

    Each of C cells has the mass 1 / C, and a quarter of the mass is cut off on either side, from a
    cell in part where C / 4 is no whole number: of three cells the middle one counts four times as
    much as the others. Where it is whole, this is a mean trimmed by 25 %.
    """
    defined = cells.defining(key)
    if not len(defined):
        return None
    clusters = _Clusters.of(defined)

    def statistic(counts: Floats) -> Floats:
        times = np.ones((len(defined), len(counts)))
        if clusters.unit == "training":
            times = counts.T[clusters.trainings(defined)]
        return _middle_mean(_pooled(clusters, counts, defined, key), times)

    return clusters.found(statistic)


@_remembered_estimate
def difference_of(cells: CellTable, reference: CellTable, key: str) -> Estimate | None:
    """Return the mean of the paired differences to the cells of a reference under the same
    conditions (`paired_difference`); None if they have none in common.
    """
    value = paired_difference(cells, reference, key)
    if value is None:
        return None
    own, other = paired(cells, reference, key)
    clusters = _Clusters.of(own, other)

    def statistic(counts: Floats) -> Floats:
        left = _pooled(clusters, counts, own, key)
        right = _pooled(clusters, counts, other, key)
        return _mean(clusters, counts, own, left - right)

    return clusters.estimate(value, statistic)


@_remembered_estimate
def improvement_over(
    cells: CellTable,
    reference: CellTable,
    key: str,
    better: Literal["up", "down"],
) -> Estimate | None:
    """Return the probability of improvement (Agarwal et al. 2021) over a reference: that an episode
    is better than one of the reference under the same condition. None without common conditions.

    Ties count one half. It is the Mann-Whitney U of the episodes of two cells of the same task,
    operator, severity and seed, divided by the number of pairs; then the mean over seeds of the
    means over conditions. 0.5 is no difference.
    """
    own, other = paired(cells, reference, key)
    if not len(own):
        return None
    clusters = _Clusters.of(own, other)
    by_world = clusters.unit == "world"
    # The index of the world of each episode. If trainings are resampled, all worlds are as one.
    worlds = 1
    own_worlds = np.zeros(len(own.place), np.intp)
    other_worlds = np.zeros(len(other.place), np.intp)
    if by_world:
        worlds = len(clusters.names)
        own_worlds = clusters.place(own.worlds)
        other_worlds = clusters.place(other.worlds)

    # Of each pair of cells how often one is better, by the worlds of both episodes.
    sign = 1.0 if better == "up" else -1.0
    mine = sign * own.episodes(key)
    theirs = sign * other.episodes(key)
    won: list[tuple[Floats, Floats]] = []
    for c in range(len(own)):
        one = own.rows_of(c)
        two = other.rows_of(c)
        won.append(_by_world(mine[one], theirs[two], own_worlds[one], other_worlds[two], worlds))

    def statistic(counts: Floats) -> Floats:
        times = counts if by_world else np.ones((1, 1))
        numbers = []
        for larger, pairs in won:
            total = ((times @ larger) * times).sum(1)
            mass = ((times @ pairs) * times).sum(1)
            numbers.append(_ratio(total, mass))
        return _mean(clusters, counts, own, np.stack(numbers, 1))

    return clusters.found(statistic)


def _by_world(
    x: Floats, y: Floats, x_place: Places, y_place: Places, worlds: int
) -> tuple[Floats, Floats]:
    """[K, K] each: in how many pairs of episodes of two worlds x is larger (ties one half), and
    of how many pairs.
    """
    larger = (x[:, None] > y) + 0.5 * (x[:, None] == y)
    defined = np.where(np.isnan(x[:, None] - y), 0.0, 1.0)
    place = (x_place[:, None] * worlds + y_place).ravel()

    def summed(of_pairs: Floats) -> Floats:
        sums = np.bincount(place, of_pairs.ravel(), worlds**2)
        return np.asarray(sums, np.float64).reshape(worlds, worlds)

    return summed(larger * defined), summed(defined)


def _pooled(clusters: _Clusters, counts: Floats, cells: CellTable, key: str) -> Floats:
    """The pooled column of every cell, NaN where undefined: [R, C], or [1, C] if trainings are
    resampled, since cells are then the same in every resample.
    """
    if clusters.unit == "training":
        return cells.pooled(key)[None]
    # [K, C] the sums of each cell in each world.
    worlds = len(clusters.names)
    place = clusters.place(cells.worlds) * len(cells) + cells.place
    shape = (worlds, len(cells))
    total, mass = [
        np.bincount(place, part, worlds * len(cells)).reshape(shape) for part in cells.weighted(key)
    ]
    return _ratio(counts @ total, counts @ mass)


def _ratio(total: Floats, mass: Floats) -> Floats:
    quotient: Floats = np.divide(total, mass, out=np.full(total.shape, np.nan), where=mass > 0)
    return quotient


def _mean(clusters: _Clusters, counts: Floats, cells: CellTable, numbers: Floats) -> Floats:
    """[R] the mean over trainings of the mean numbers [R or 1, C] of their cells, or over the
    seeds of the only one; NaN does not count.
    """
    if clusters.unit == "world":
        _, seed, many = np.unique(cells.seeds, return_inverse=True, return_counts=True)
        # seeds count alike, as in `summarise`
        times = np.broadcast_to(1.0 / many[seed], numbers.shape)
    else:
        place = clusters.trainings(cells)
        numbers = (np.bincount(place, numbers[0]) / np.bincount(place))[None]
        times = counts
    times = times * ~np.isnan(numbers)
    return _ratio((np.nan_to_num(numbers) * times).sum(1), times.sum(1))


def _middle_mean(numbers: Floats, times: Floats) -> Floats:
    """[R] the mean of the middle half of numbers [R or 1, C] that count several times [C, R]."""
    order = np.argsort(numbers, axis=1, kind="stable").T  # undefined ones last
    numbers = np.take_along_axis(numbers.T, order, 0)
    times = times[order[:, 0]] if order.shape[1] == 1 else np.take_along_axis(times, order, 0)
    if np.isnan(numbers).any():
        times = times * ~np.isnan(numbers)
    upper = np.cumsum(times, 0)
    total = upper[-1]
    kept = np.minimum(upper, (1 - TRIMMED) * total) - np.maximum(upper - times, TRIMMED * total)
    np.maximum(kept, 0.0, out=kept)
    return _ratio((np.nan_to_num(numbers) * kept).sum(0), (1 - 2 * TRIMMED) * total)


@dataclass(frozen=True)
class Contrast:
    """A contrast over trainings; limits are None where they are undefined."""

    value: float
    trainings: tuple[float, ...]  # the contrast of each training, in the order of their seeds
    bootstrap: Limits | None
    t: Limits | None


def _plain_contrast(plain: list[Any]) -> Contrast:
    value, trainings, bootstrap, t = plain
    return Contrast(
        value,
        tuple(trainings),
        None if bootstrap is None else (bootstrap[0], bootstrap[1]),
        None if t is None else (t[0], t[1]),
    )


@remembered(astuple, _plain_contrast)
def contrast_of(
    cells: CellTable,
    reference: CellTable | float,
    key: str,
    margin: float = 0.0,
) -> Contrast | None:
    """Return the contrast of cells with the cells of a reference under the same conditions, or with
    a number; see the module. None if they have no condition in common.

    Args:
        margin: the share of |right| that is subtracted.
    """
    if isinstance(reference, float):
        if not cells.has(key):
            return None
        # Cells that have the number wherever the column is defined.
        undefined = np.isnan(cells.episodes(key))
        reference = cells.with_columns({key: np.where(undefined, math.nan, reference)})
    own, other = paired(cells, reference, key)
    if not len(own):
        return None

    # The trainings, each with its cells in the order of their conditions.
    order = sorted(range(len(own)), key=lambda place: repr(condition(own.cells[place])))
    own = own.choose(order)
    other = other.choose(order)
    trainings = []
    for seed in np.unique(own.trainings):
        of_training = own.trainings == seed
        trainings.append(_Training(own.choose(of_training), other.choose(of_training), key, margin))
    values = [float(one.contrast(np.ones((1, one.worlds)))[0]) for one in trainings]
    limits = limits_of(_resampled(trainings))
    resampled = len(trainings) > 1 or trainings[0].worlds > 1
    return Contrast(
        float(np.mean(values)), tuple(values), limits if resampled else None, t_limits(values)
    )


class _Training:
    """The paired sums of one training: [2, 2, K, C] of side, weighted sum and weight, world and
    condition.
    """

    def __init__(self, own: CellTable, other: CellTable, key: str, margin: float) -> None:
        names = np.unique(np.concatenate([own.worlds, other.worlds]))
        self.worlds = len(names)
        self.margin = margin
        # Seeds that share the training are one.
        conditions = list(dict.fromkeys(condition(cell)[:3] for cell in own))
        of_cell = np.array([conditions.index(condition(cell)[:3]) for cell in own])
        self.sums = np.zeros((2, 2, len(names), len(conditions)))
        for side, cells in enumerate((own, other)):
            world = np.searchsorted(names, cells.worlds)
            place = world * len(conditions) + of_cell[cells.place]
            for part, weights in enumerate(cells.weighted(key)):
                sums = np.bincount(place, weights, len(names) * len(conditions))
                self.sums[side, part] = sums.reshape(len(names), len(conditions))

    def contrast(self, counts: Floats) -> Floats:
        """[R] the contrast when each world counts so often [R, K]; conditions that a side
        leaves undefined do not count.
        """
        # [2, R, C] of both sides: the pooled columns, as sums and weights.
        total = counts @ self.sums[:, 0]
        mass = counts @ self.sums[:, 1]
        pooled = np.divide(total, mass, out=np.zeros_like(total), where=mass > 0)

        # The contrast of the means over the conditions [R] that both sides define.
        defined = (mass > 0).all(0)
        number = defined.sum(1)
        left, right = np.where(defined, pooled, 0.0).sum(2)
        contrasts: Floats = np.full(len(counts), np.nan)
        np.divide(
            left - right - self.margin * np.abs(right), number, out=contrasts, where=number > 0
        )
        return contrasts


def _resampled(trainings: Sequence[_Training]) -> Floats:
    """[R] the mean contrast of every resample; resamples that a drawn training leaves undefined
    are NaN.
    """
    total = np.zeros(RESAMPLES)
    for s, chosen, counts in _drawn(tuple(training.worlds for training in trainings)):
        total[chosen] += trainings[s].contrast(counts)
    return total / len(trainings)


@lru_cache(maxsize=8)
def _drawn(worlds: tuple[int, ...]) -> list[tuple[int, NDArray[np.bool_], Floats]]:
    """For every place and training with so many worlds: its index, which resamples drew it
    there, and how often each of its worlds.
    """
    draws = np.random.PCG64(SEED)
    resamples = []
    for _ in worlds:
        picks = _picks(draws, len(worlds), 1)[:, 0]
        for s, many in enumerate(worlds):
            resamples.append((s, picks == s, _times_drawn(draws, many)[picks == s]))
    return resamples


def t_limits(values: Sequence[float]) -> Limits | None:
    """Return the 95 % t interval of the mean of n values, mean -+ t(.975, n - 1) sd / sqrt(n); None
    with one value.
    """
    from scipy.special import stdtrit

    if len(values) < 2:
        return None
    mean = float(np.mean(values))
    quantile = float(stdtrit(len(values) - 1, (1 + COVERAGE) / 2))
    half = quantile * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return mean - half, mean + half
