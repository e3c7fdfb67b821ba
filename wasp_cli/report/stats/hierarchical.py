"""Contrasts with a margin within each training, with a hierarchical bootstrap over trainings and worlds, and a t interval beside it.

The contrast of training s is left - right - margin x |right|, each side the mean over conditions (operator, severity) of the column
pooled over worlds; a negative margin asks for that much less, a positive one allows or asks for that much more. A resample draws S of
S trainings with replacement, and for each drawn training anew as many of its worlds as it has; a world brings its episodes under all
operators and both methods. 95 % of RESAMPLES resamples lie within the interval of percentiles. With one training only worlds are drawn.
Evaluation seeds that share a training's models (`training_seed`) are one training, with the worlds of all of them.
The t interval, mean -+ t(.975, S - 1) sd / sqrt(S) of the S contrasts, shows how little a few trainings say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from wasp_cli.report.stats.bootstrap import COVERAGE, RESAMPLES, SEED, Limits, limits_of
from wasp_cli.report.stats.frame import CellNumbers, Floats
from wasp_cli.report.stats.summary import condition


@dataclass(frozen=True)
class Contrast:
    """A contrast over trainings; limits are None where they are undefined."""

    value: float
    trainings: tuple[float, ...]  # the contrast of each training, in the order of their seeds
    bootstrap: Limits | None
    t: Limits | None


def contrast_of(cells: Sequence[CellNumbers], reference: Sequence[CellNumbers] | float, key: str, margin: float = 0.0) -> Contrast | None:
    """Return the contrast of the cells to a number, or to a reference's cells under the same conditions; None where they share none."""
    if isinstance(reference, float):
        reference = [_constant(cell, key, reference) for cell in cells if key in cell.episodes]
    defined = ([cell for cell in side if not math.isnan(cell.pooled.get(key, math.nan))] for side in (cells, reference))
    own, other = ({condition(cell.identity): cell for cell in side} for side in defined)
    shared = sorted(own.keys() & other.keys(), key=repr)
    seeds = sorted({own[place].training for place in shared})
    if not seeds:
        return None
    pairs = [[(own[place], other[place]) for place in shared if own[place].training == seed] for seed in seeds]
    trainings = [_Training(each, key, margin) for each in pairs]
    values = [float(one.contrast(np.ones((1, one.worlds)))[0]) for one in trainings]
    limits = limits_of(_resampled(trainings))
    return Contrast(float(np.mean(values)), tuple(values), limits if len(seeds) > 1 or trainings[0].worlds > 1 else None, t_limits(values))


def _constant(cell: CellNumbers, key: str, number: float) -> CellNumbers:
    """The cell with a number for every defined value of a column."""
    column, pooled = cell.episodes[key], cell.pooled.get(key, math.nan)
    changed = {key: np.where(np.isnan(column), math.nan, number)}
    return replace(cell, episodes={**cell.episodes, **changed}, pooled={key: math.nan if math.isnan(pooled) else number})


class _Training:
    """The paired sums of one training: [2, 2, K, C] of side, weighted sum and weight, world and condition."""

    def __init__(self, pairs: Sequence[tuple[CellNumbers, CellNumbers]], key: str, margin: float) -> None:
        names = np.unique(np.concatenate([cell.episodes["world"] for pair in pairs for cell in pair]))
        self.worlds, self.margin = len(names), margin
        conditions = list(dict.fromkeys(condition(own.identity)[:3] for own, _ in pairs))  # seeds that share the training are one
        self.sums = np.zeros((2, 2, len(names), len(conditions)))
        for pair in pairs:
            c = conditions.index(condition(pair[0].identity)[:3])
            for side, cell in enumerate(pair):
                place = np.searchsorted(names, cell.episodes["world"])
                for part, weights in enumerate(cell.weighted(key)):
                    self.sums[side, part, :, c] += np.bincount(place, weights, len(names))

    def contrast(self, counts: Floats) -> Floats:
        """[R] the contrast when each world counts so often [R, K]; conditions that a side leaves undefined do not count."""
        total, mass = counts @ self.sums[:, 0], counts @ self.sums[:, 1]
        defined = (mass > 0).all(0)
        left, right = np.where(defined, np.divide(total, mass, out=np.zeros_like(total), where=mass > 0), 0.0).sum(2)
        number = defined.sum(1)
        found: Floats = np.full(len(counts), np.nan)
        np.divide(left - right - self.margin * np.abs(right), number, out=found, where=number > 0)
        return found


def _resampled(trainings: Sequence[_Training]) -> Floats:
    """[R] the mean contrast of every resample; resamples that a drawn training leaves undefined are NaN."""
    total = np.zeros(RESAMPLES)
    for s, chosen, counts in _drawn(tuple(training.worlds for training in trainings)):
        total[chosen] += trainings[s].contrast(counts)
    return total / len(trainings)


@lru_cache(maxsize=8)
def _drawn(worlds: tuple[int, ...]) -> list[tuple[int, np.ndarray[tuple[int], np.dtype[np.bool_]], Floats]]:
    """For every place and training with so many worlds: its index, which resamples drew it there, and how often each of its worlds."""
    draws, found = np.random.PCG64(SEED), []
    for _ in worlds:
        picks = _below(draws, len(worlds), 1)[:, 0]
        for s, many in enumerate(worlds):
            rows = np.arange(RESAMPLES)[:, None] * many
            counts = np.bincount((rows + _below(draws, many, many)).ravel(), minlength=rows.size * many).reshape(RESAMPLES, -1)
            found.append((s, picks == s, counts[picks == s].astype(np.float64)))
    return found


def _below(draws: np.random.PCG64, bound: int, columns: int) -> np.ndarray[tuple[int, int], np.dtype[np.intp]]:
    """[R, columns] whole numbers below a bound, from the raw stream, which is the same in every version of NumPy."""
    bits = draws.random_raw(RESAMPLES * columns).reshape(RESAMPLES, columns) >> np.uint64(32)
    found = (bits * np.uint64(bound)) >> np.uint64(32)
    return found.astype(np.intp)


def t_limits(values: Sequence[float]) -> Limits | None:
    """Return the 95 % t interval of the mean of n values, with n - 1 degrees of freedom; None with one value."""
    if len(values) < 2:
        return None
    half = _t_quantile(len(values) - 1) * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return float(np.mean(values)) - half, float(np.mean(values)) + half


def _t_quantile(freedom: int) -> float:
    """The quantile t for which P(|T| < t) is COVERAGE, by halving: the series of Abramowitz and Stegun, 26.7.3 and 26.7.4."""

    def within(t: float) -> float:
        angle, term, total = math.atan(t / math.sqrt(freedom)), 1.0, 0.0
        for k in range(1 if freedom % 2 == 0 else 2, freedom, 2):
            total, term = total + term, term * k / (k + 1) * math.cos(angle) ** 2
        if freedom % 2 == 0:
            return math.sin(angle) * total
        return 2 / math.pi * (angle + math.sin(angle) * math.cos(angle) * total)

    low, high = 0.0, 100.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if within(middle) < COVERAGE else (low, middle)
    return low
