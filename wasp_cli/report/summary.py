"""From cells to a row of a table: means over cells, spread over seeds, and how coarse that spread
is.

Episodes of one seed share its trained models, so they are not independent: the unit of every spread
is the seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from wasp_cli.cells.table import CellTable, Floats, Places, condition, paired
from wasp_cli.metrics.episode import WEIGHTS
from wasp_cli.store.tables import ADDED

HAPPENED = frozenset(WEIGHTS) - {"safety_gate", "task_gate", "case2", *ADDED}
"""Columns of an episode that say what happened and what was corrected; without the gates, and
without columns that rows of earlier versions do not have.
"""


@dataclass(frozen=True)
class Interval:
    """The limits of an interval, and what was resampled for them."""

    low: float
    high: float
    unit: Literal["training", "world", "participant"]
    clusters: int  # K, how many of them were resampled

    @property
    def words(self) -> str:
        """What the limits are: with two or three clusters a range, since one resample in 27 draws
        the same of three clusters, and so the percentiles are the least and the largest.
        """
        if self.clusters <= FEW:
            return f"range of {'two' if self.clusters == 2 else 'three'} {self.unit}s"
        return f"95 % interval over {self.clusters} {self.unit}s"


FEW = 3  # clusters up to which 95 % of the resamples reach from the least to the largest


@dataclass(frozen=True)
class Value:
    """A number of a table; a mean of None is undefined."""

    mean: float | None
    sd: float | None = None  # spread over seed-level means; None with fewer than two seeds
    n: int = 0  # seeds behind the mean
    delta: float | None = None  # difference to a reference row, where a table has one
    ranked: bool = True  # whether it may be the best of its column
    interval: Interval | None = None  # where the mean may lie, and what says so


UNDEFINED = Value(None, ranked=False)


def seed_means(cells: CellTable, key: str) -> dict[int, float]:
    """Return the mean of a pooled column over the cells of each seed, by seed. Cells that leave it
    undefined do not count.
    """
    defined = cells.defining(key)
    seeds = np.unique(defined.seeds)
    means = _means_of_seeds(defined.seeds, defined.pooled(key))
    return dict(zip(seeds.tolist(), means.tolist(), strict=True))


def over_seeds(means: Iterable[float], ranked: bool = True) -> Value:
    """Return the mean of the means of seeds, with their standard deviation (ddof = 1) as its
    spread. One seed has no spread, and is not ranked.
    """
    numbers = list(means)
    if not numbers:
        return UNDEFINED
    mean = float(np.mean(numbers))
    # Without a spread, a difference to other rows may be chance: it is not ranked.
    if len(numbers) == 1:
        return Value(mean, n=1, ranked=False)
    return Value(mean, float(np.std(numbers, ddof=1)), len(numbers), ranked=ranked)


def summarise(cells: CellTable, key: str) -> Value:
    """Return the mean over seeds of a pooled column. It has no spread if seeds have cells under
    different conditions, whose means differ by more than chance.
    """
    value = over_seeds(seed_means(cells, key).values())
    return value if even(cells.defining(key)) else replace(value, sd=None)


def even(cells: CellTable) -> bool:
    """Tell whether all seeds have cells under the same conditions."""
    by_seed: dict[int, set[object]] = {}
    for cell in cells:
        by_seed.setdefault(cell.seed, set()).add(condition(cell)[:3])
    return len({frozenset(conditions) for conditions in by_seed.values()}) <= 1


def over_episodes(cells: CellTable, key: str, reduce: Callable[[Floats], float]) -> Value:
    """Reduce a column [N] over the episodes of all cells together; the value has no spread."""
    numbers = cells.episodes(key)
    defined = numbers[~np.isnan(numbers)]
    if not len(defined):
        return UNDEFINED
    return Value(float(reduce(defined)), n=len(np.unique(cells.seeds)), ranked=False)


def paired_difference(cells: CellTable, reference: CellTable, key: str) -> float | None:
    """Return the mean difference to a reference over the cells and worlds that both have
    (`cells.table.paired`): the mean over seeds of the means over cells. None if they have none in
    common.
    """
    own, other = paired(cells, reference, key)
    if not len(own):
        return None
    return float(np.mean(_means_of_seeds(own.seeds, own.pooled(key) - other.pooled(key))))


def same_episodes(cells: CellTable, reference: CellTable) -> tuple[int, int]:
    """Count the episodes that went exactly as the reference's did in the same world, and all that
    both have.

    An episode went the same way if what happened and what was corrected are equal to the bit. Gates
    may differ, and decision times always do.
    """
    own, other = paired(cells, reference, "cost")
    # By cell, then by world.
    rows = np.lexsort((own.worlds, own.place))
    others = np.lexsort((other.worlds, other.place))
    alike = np.ones(len(rows), bool)
    for name in HAPPENED:
        if own.has(name) and other.has(name):
            left = own.episodes(name)[rows]
            right = other.episodes(name)[others]
            alike &= (left == right) | (np.isnan(left) & np.isnan(right))
    return int(alike.sum()), len(alike)


def spread_note(cells: CellTable) -> str:
    """Return the sentence that explains the ± of a table."""
    seeds = len(np.unique(cells.seeds))
    if not seeds:
        return "No cell has been computed yet."
    if seeds == 1:
        return (
            "One seed: no ±, and nothing is marked as best. Differences between methods may be "
            "chance; more seeds say more."
        )
    return f"± is the standard deviation over the means of {seeds} seeds, not over episodes."


def _means_of_seeds(seeds: Places, numbers: Floats) -> Floats:
    """[S] the mean number of the cells of each seed, in the order of the seeds."""
    _, place = np.unique(seeds, return_inverse=True)
    means: Floats = np.bincount(place, numbers) / np.bincount(place)
    return means
