"""The episodes of two evaluations of one cell, paired by their worlds: by how much they differ, and
whether that is more than noise.

Under the hypothesis that the two evaluations are alike, the difference of every world could as well
have the other sign, for all measures at once: the p-value of a measure is the share of the 2^n
flips (all of them up to EXACT worlds, else FLIPS draws) in which the largest of all standardised
differences reaches that of the measure (Westfall and Young 1993). So p-values are corrected for the
number of measures already; `corrected` does the same for the number of cells (Holm 1979). What
counts as noise is chance over worlds, for the models of these two evaluations.

Letters: n worlds (episodes), M measures, R flips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.table import CellTable
from wasp_cli.report.bootstrap import COVERAGE, SEED, Estimate, drawn
from wasp_cli.report.summary import Interval

MEASURES = ("return", "cost", "viol", "int_rate", "success")
EXACT = 13  # worlds up to which all flips are tried
FLIPS = 10_000


@dataclass(frozen=True)
class Difference(Estimate):
    """A measure of one cell, after minus before, as a mean over episodes."""

    p: float  # corrected for the number of measures


@dataclass(frozen=True)
class Paired:
    """What the worlds that two evaluations share say of their difference."""

    differences: Mapping[str, Difference]  # by measure
    worlds: int  # n, those that both have
    episodes: tuple[int, int]
    least: float  # the smallest p-value that so many episodes can have


def paired_episodes(before: CellTable, after: CellTable) -> Paired | None:
    """Compare the episodes of two evaluations, each a table of one cell; None where they have no
    world in common.
    """
    common, left, right = np.intersect1d(before.worlds, after.worlds, return_indices=True)
    if not len(common):
        return None
    x = np.stack([before.episodes(name) for name in MEASURES], 1)
    y = np.stack([after.episodes(name) for name in MEASURES], 1)
    change = y[right] - x[left]  # [n, M]
    n = len(change)

    # Intervals of the mean change, over worlds.
    intervals: list[Interval | None] = [None] * len(MEASURES)
    if n > 1:
        resampled = drawn(n) @ change / n
        limits = np.quantile(resampled, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2], axis=0)
        intervals = [Interval(float(low), float(high), "world", n) for low, high in limits.T]

    # The largest of all standardised changes under every flip of signs.
    moved = change[np.any(change != 0, 1)]  # a world without any difference has no sign
    signs, exact = _signs(len(moved))
    # the same under every flip; 0 of a measure that never differs
    size = np.sqrt(np.square(moved).sum(0))
    flipped = _over(np.abs(signs @ moved), size)
    own = _over(np.abs(moved.sum(0)), size)
    reached = (flipped.max(1)[:, None] >= own * (1 - 1e-12)).sum(0)
    if exact:
        p = reached / len(signs)
        least = 2.0 ** (1 - len(moved)) if len(moved) else 1.0
    else:
        p = (reached + 1) / (FLIPS + 1)
        least = 1 / (FLIPS + 1)

    differences = {}
    means = change.mean(0).tolist()
    for name, mean, interval, of_measure in zip(
        MEASURES, means, intervals, p.tolist(), strict=True
    ):
        differences[name] = Difference(mean, interval, of_measure)
    return Paired(differences, n, (len(x), len(y)), least)


def _signs(worlds: int) -> tuple[NDArray[np.float64], bool]:
    """[R, worlds] the flips of signs, and whether these are all that there are."""
    if worlds <= EXACT:
        flips = (np.arange(2**worlds)[:, None] >> np.arange(worlds)) & 1
        return 1.0 - 2.0 * flips.astype(np.float64), True
    bits = np.random.PCG64(SEED).random_raw((FLIPS, worlds)) >> np.uint64(63)
    return 1.0 - 2.0 * bits.astype(np.float64), False


def _over(values: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values [..., M] by the size of each measure; 0 where it has none."""
    quotient: NDArray[np.float64] = np.divide(
        values, size, out=np.zeros_like(values), where=size > 0
    )
    return quotient


def corrected(cells: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """Correct the p-values of measures for the number of cells by Holm's steps: cells in the
    order of their smallest one.
    """
    order = sorted(range(len(cells)), key=lambda i: min(cells[i].values()))
    adjusted: list[dict[str, float]] = [{} for _ in cells]
    floor = 0.0
    for step, i in enumerate(order):
        adjusted[i] = {
            name: min(1.0, max(floor, (len(cells) - step) * p)) for name, p in cells[i].items()
        }
        floor = min(adjusted[i].values())
    return adjusted
