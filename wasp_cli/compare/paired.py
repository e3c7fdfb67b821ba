"""Whether two evaluations of one cell differ by more than noise: per measure a difference, its interval and a p-value.

Episodes of the same world are pairs. Under the hypothesis that the two evaluations are alike, every world's difference could as well have
the other sign, for all measures at once: the p-value of a measure is the share of the 2^n flips (all of them up to EXACT worlds, else
FLIPS draws) in which the largest of all standardised differences reaches the measure's own (Westfall and Young 1993). So p-values are
corrected for the number of measures already; `corrected` does the same for the number of cells (Holm 1979). Without worlds in common the
labels of the episodes are permuted instead. What counts as noise is chance over worlds, for the models of these two evaluations.

Letters: n worlds (episodes), M measures, R flips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from wasp_cli.report.stats.bootstrap import COVERAGE, SEED, drawn
from wasp_cli.report.stats.frame import CellNumbers, Floats
from wasp_cli.report.stats.summary import Interval

MEASURES = ("return", "cost", "viol", "int_rate", "success")
EXACT = 13  # worlds up to which all flips are tried
FLIPS = 10_000
LEVEL = 0.05


@dataclass(frozen=True)
class Difference:
    """A measure of one cell, after minus before, as a mean over episodes."""

    value: float
    interval: Interval | None  # None with a single world
    p: float  # corrected for the number of measures


@dataclass(frozen=True)
class Paired:
    """Two evaluations of a cell side by side."""

    differences: Mapping[str, Difference]  # by measure
    worlds: int  # n, those that both have; 0 where episodes are compared unpaired
    episodes: tuple[int, int]
    least: float  # the smallest p-value that so many episodes can have


def paired_episodes(before: CellNumbers, after: CellNumbers) -> Paired:
    """Compare the episodes of two evaluations."""
    x, y = (np.stack([cell.episodes[name] for name in MEASURES], 1) for cell in (before, after))
    common, left, right = np.intersect1d(before.episodes["world"], after.episodes["world"], return_indices=True)
    episodes = (len(x), len(y))
    if len(common):
        values, intervals, p, least = _by_world(y[right] - x[left])
    else:
        values, intervals, p, least = _unpaired(x, y)
    found = {name: Difference(float(values[i]), intervals[i], float(p[i])) for i, name in enumerate(MEASURES)}
    return Paired(found, len(common), episodes, least)


Found = tuple[Floats, list[Interval | None], Floats, float]
"""[M] differences, their intervals, [M] p-values, and the smallest p-value that there can be."""


def _by_world(change: Floats) -> Found:
    """From the differences [n, M] of each world."""
    n = len(change)
    intervals: list[Interval | None] = _intervals(drawn(n) @ change / n, n) if n > 1 else [None] * change.shape[1]
    moved = change[np.any(change != 0, 1)]  # a world without any difference has no sign
    exact = len(moved) <= EXACT
    if exact:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(moved))[:, None] >> np.arange(len(moved))) & 1)
    else:
        bits = np.random.PCG64(SEED).random_raw((FLIPS, len(moved))) >> np.uint64(63)
        signs = 1.0 - 2.0 * bits.astype(np.float64)
    size = np.sqrt(np.square(moved).sum(0))  # the same under every flip
    p = _shares(_over(np.abs(signs @ moved), size), _over(np.abs(moved.sum(0)), size), exact)
    return change.mean(0), intervals, p, 2.0 ** (1 - len(moved)) if exact and len(moved) else 1.0 if exact else 1 / (FLIPS + 1)


def _unpaired(x: Floats, y: Floats) -> Found:
    """From the episodes [n, M] of each."""
    both, n = np.concatenate([x, y]), len(x)
    counts = drawn(len(both))
    drawn_x, drawn_y = counts[:, :n], counts[:, n:]
    usable = (drawn_x.sum(1) > 0) & (drawn_y.sum(1) > 0)
    means = [(part[usable] @ rows) / part[usable].sum(1, keepdims=True) for part, rows in ((drawn_x, x), (drawn_y, y))]
    intervals = _intervals(means[1] - means[0], len(both))
    order = np.argsort(np.random.PCG64(SEED).random_raw((FLIPS, len(both))), axis=1)
    first = np.zeros((FLIPS, len(both)))
    np.put_along_axis(first, order[:, :n], 1.0, 1)
    total = both.sum(0)
    shuffled = (total - first @ both) / len(y) - first @ both / n
    value, size = y.mean(0) - x.mean(0), both.std(0)
    p = _shares(_over(np.abs(shuffled), size), _over(np.abs(value), size), exact=False)
    return value, intervals, p, 1 / (FLIPS + 1)


def _intervals(means: Floats, clusters: int) -> list[Interval | None]:
    """Of resampled means [R, M]."""
    low, high = np.quantile(means, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2], axis=0)
    return [Interval(float(a), float(b), "world", clusters) for a, b in zip(low, high, strict=True)]


def _over(values: Floats, size: Floats) -> Floats:
    """Standardised; 0 of a measure that never differs."""
    found: Floats = np.divide(values, size, out=np.zeros_like(values), where=size > 0)
    return found


def _shares(flipped: Floats, own: Floats, exact: bool) -> Floats:
    """[M] in which share of the flips [R, M] the largest measure reaches each measure's own value [M]."""
    reached: Floats = (flipped.max(1)[:, None] >= own * (1 - 1e-12)).sum(0).astype(np.float64)
    return reached / len(flipped) if exact else (reached + 1) / (len(flipped) + 1)


def corrected(cells: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """Correct the p-values of measures for the number of cells by Holm's steps: cells in the order of their smallest one."""
    order = sorted(range(len(cells)), key=lambda i: min(cells[i].values()))
    found: list[dict[str, float]] = [{} for _ in cells]
    floor = 0.0
    for step, i in enumerate(order):
        found[i] = {name: min(1.0, max(floor, (len(cells) - step) * p)) for name, p in cells[i].items()}
        floor = min(found[i].values())
    return found
