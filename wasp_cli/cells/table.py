"""One table of cells and their episodes.

Letters: C cells, N episodes of all cells together, K worlds.

    table = read_cells(layout, run.cells).table
    table.episodes("cost")                      [N] of each episode, cell after cell
    table.pooled("viol")                        [C] of each cell, its episodes pooled
    wasp = table.where(lambda cell: cell.method == "wasp")
    own, other = paired(wasp, human, "cost")    the cells and worlds that both have

A column of `WEIGHT_OF` pools as `metrics.episode.pool` does: rates are ratios of sums. Undefined
numbers are NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.metrics.episode import WEIGHTS
from wasp_cli.store.tables import CellIdentity, Thresholds

Floats = NDArray[np.float64]
Places = NDArray[np.intp]

# columns that weigh others (metrics.episode.WEIGHTS)
POOLING = ("decisions", "env_steps", "intervened", "planned", "handovers")
# columns of which a cell has the median over its episodes
TIMES = ("decision_p50_ms", "decision_p95_ms")
COLUMNS = (*WEIGHTS, *POOLING, *TIMES, "episode_seed")  # what is read of a cell
# the seed of an episode's world, which is the same under every assistant and operator of a task and
# seed; and the number of the episode in its cell, from 0
WORLD = "world"
EPISODE = "episode"

JUDGED = ("uir", "uir_swapped", "uir_eff", "rho", "at_risk", "delta_c", "delta_r")
"""Columns of the counterfactual evaluation, where branches were read (`cells.judged`)."""

BRANCHED = "branches"
EFFECTIVE = "effective_branches"
"""Columns of how many decisions of an episode were branched, and of how many of these the
branches differ.
"""

WEIGHT_OF: dict[str, str | None] = {
    **WEIGHTS,
    "smoothness": "jumps",
    **dict.fromkeys(JUDGED, BRANCHED),
    "uir_eff": EFFECTIVE,
}
"""The columns that are means over episodes, each with the column that weighs it; None is one
weight per episode.
"""

Condition = tuple[str, str, float | None, int]


class CellTable:
    """Cells and their episodes, which come cell after cell.

    What is chosen of a table is a table. Its columns and pooled numbers are made when they are
    asked for, and kept: do not write into them.
    """

    def __init__(
        self,
        cells: Sequence[RecordedCell],
        counts: Sequence[int] | Places,
        columns: Mapping[str, Floats],
        thresholds: Sequence[Thresholds] | None = None,
    ) -> None:
        """Make a table of columns.

        Args:
            cells: C cells.
            counts: [C] how many episodes each has.
            columns: [N] each, by name.
            thresholds: [C] in force in each cell; None: nothing is known of them.
        """
        self.cells = tuple(cells)
        self.counts: Places = np.asarray(counts, np.intp)
        self.thresholds = tuple(thresholds or [Thresholds()] * len(self.cells))
        self._columns = dict(columns)
        self._pooled: dict[str, Floats] = {}
        # Of what was made of other tables: where its columns and pooled numbers come from.
        self._origin: _Origin | None = None

    def __len__(self) -> int:
        """The number of cells."""
        return len(self.cells)

    def __iter__(self) -> Iterator[RecordedCell]:
        return iter(self.cells)

    @cached_property
    def starts(self) -> Places:
        """[C + 1] where the episodes of each cell begin, and the number of all episodes."""
        return np.concatenate([[0], np.cumsum(self.counts)]).astype(np.intp)

    @cached_property
    def place(self) -> Places:
        """[N] which cell each episode is of."""
        return np.repeat(np.arange(len(self)), self.counts)

    @cached_property
    def seeds(self) -> Places:
        """[C] the seed of each cell."""
        return np.array([cell.seed for cell in self.cells], np.intp)

    @cached_property
    def trainings(self) -> Places:
        """[C] the seed of the training whose models each cell uses."""
        return np.array([cell.training for cell in self.cells], np.intp)

    @property
    def worlds(self) -> Floats:
        """[N] the seed of the world of each episode."""
        return self.episodes(WORLD)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all columns."""
        return tuple(self._columns) if self._origin is None else self._origin.names

    def has(self, name: str) -> bool:
        """Whether there is such a column."""
        return name in self.names

    def episodes(self, name: str) -> Floats:
        """Return [N] a column. Raises KeyError where there is none of this name."""
        if name not in self._columns and self._origin is not None:
            self._columns[name] = self._origin.episodes(name)
        return self._columns[name]

    def pooled(self, name: str) -> Floats:
        """Return [C] the number of each cell: a column of WEIGHT_OF, or the median of one of
        TIMES. NaN where a cell leaves it undefined, and where there is no such column.
        """
        if name not in self._pooled:
            self._pooled[name] = self._pool(name)
        return self._pooled[name]

    def weighted(self, name: str) -> tuple[Floats, Floats]:
        """Return [N] each: weight x value, and weight, of a column of WEIGHT_OF; both 0 where it
        is undefined. The pooled number of a cell is the ratio of their sums.
        """
        values = self.episodes(name)
        weight = WEIGHT_OF[name]
        whole = np.ones(len(values)) if weight is None else self.episodes(weight)
        mass = np.where(np.isnan(values), 0.0, whole)
        return mass * np.nan_to_num(values), mass

    def rows_of(self, place: int) -> slice:
        """Return where the episodes of one cell are."""
        return slice(int(self.starts[place]), int(self.starts[place + 1]))

    def choose(self, places: Sequence[int] | Places | NDArray[np.bool_]) -> CellTable:
        """Return some cells: by their places, in that order, or by a mask [C]."""
        chosen = np.asarray(places)
        if chosen.dtype == np.bool_:
            chosen = np.flatnonzero(chosen)
        chosen = chosen.astype(np.intp)
        part = CellTable(
            [self.cells[place] for place in chosen],
            self.counts[chosen],
            {},
            [self.thresholds[place] for place in chosen],
        )
        part._origin = _Choice(self, chosen, part)
        return part

    def where(self, holds: Callable[[RecordedCell], bool]) -> CellTable:
        """Return the cells of which something holds."""
        return self.choose([place for place, cell in enumerate(self.cells) if holds(cell)])

    def defining(self, name: str) -> CellTable:
        """Return the cells that define a pooled number."""
        defined = ~np.isnan(self.pooled(name))
        return self if defined.all() else self.choose(defined)

    def with_episodes(self, kept: NDArray[np.bool_]) -> CellTable:
        """Return the table with those episodes alone for which `kept` [N] is true. Cells without
        any are left out.
        """
        if kept.all():
            return self
        counts = np.bincount(self.place[kept], minlength=len(self))
        left = np.flatnonzero(counts)
        return CellTable(
            [self.cells[place] for place in left],
            counts[left],
            {name: self.episodes(name)[kept] for name in self.names},
            [self.thresholds[place] for place in left],
        )

    def with_columns(self, columns: Mapping[str, Floats]) -> CellTable:
        """Return the table with further columns [N], or with others of the same names."""
        every = {name: self.episodes(name) for name in self.names}
        return CellTable(self.cells, self.counts, {**every, **columns}, self.thresholds)

    @classmethod
    def joined(cls, tables: Sequence[CellTable]) -> CellTable:
        """Return the cells of several tables, one after the other, with the columns that all of
        them have.
        """
        whole = cls(
            [cell for table in tables for cell in table.cells],
            [int(count) for table in tables for count in table.counts],
            {},
            [each for table in tables for each in table.thresholds],
        )
        if tables:
            whole._origin = _Join(tuple(tables))
        return whole

    def _pool(self, name: str) -> Floats:
        if self._origin is not None:
            return self._origin.pooled(name)
        if name in TIMES and self.has(name):
            values = self.episodes(name)
            return np.array([_median(values[self.rows_of(i)]) for i in range(len(self))])
        if name not in WEIGHT_OF or not self.has(name):
            return np.full(len(self), math.nan)
        total, mass = self.weighted(name)
        sums = np.bincount(self.place, total, len(self))
        weights = np.bincount(self.place, mass, len(self))
        pooled: Floats = np.full(len(self), math.nan)
        np.divide(sums, weights, out=pooled, where=weights > 0)
        return pooled


class _Origin(Protocol):
    """Where a table has its numbers from."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all columns."""
        ...

    def episodes(self, name: str) -> Floats:
        """Return [N] a column."""
        ...

    def pooled(self, name: str) -> Floats:
        """Return [C] a pooled number."""
        ...


@dataclass(frozen=True, eq=False)
class _Choice:
    """Some cells of a table."""

    whole: CellTable
    places: Places  # [C] of the cells there
    part: CellTable  # what they make

    @property
    def names(self) -> tuple[str, ...]:
        """The columns there are."""
        return self.whole.names

    def episodes(self, name: str) -> Floats:
        """Return a column of episodes, [N]."""
        return self.whole.episodes(name)[self._rows]

    def pooled(self, name: str) -> Floats:
        """Return a number of each cell over all of its episodes, [C]."""
        return self.whole.pooled(name)[self.places]

    @cached_property
    def _rows(self) -> Places:
        """[N] the place of each episode in the whole table: within its cell it is where it was."""
        within = np.arange(self.part.starts[-1]) - self.part.starts[self.part.place]
        return self.whole.starts[self.places][self.part.place] + within


@dataclass(frozen=True, eq=False)
class _Join:
    """The cells of several tables."""

    tables: tuple[CellTable, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The columns that every table has."""
        first = self.tables[0].names
        return tuple(name for name in first if all(table.has(name) for table in self.tables))

    def episodes(self, name: str) -> Floats:
        """Return a column of episodes, [N]."""
        return np.concatenate([table.episodes(name) for table in self.tables])

    def pooled(self, name: str) -> Floats:
        """Return a number of each cell over all of its episodes, [C]."""
        return np.concatenate([table.pooled(name) for table in self.tables])


def condition(cell: CellIdentity) -> Condition:
    """Return what two cells have in common that can be compared in pairs: task, operator,
    severity and seed.
    """
    return cell.task, cell.operator, cell.value, cell.seed


def paired(cells: CellTable, reference: CellTable, name: str) -> tuple[CellTable, CellTable]:
    """Join two tables on condition and world: the cells of both under conditions in which both
    define a pooled number, with the episodes in worlds that both have.

    The cells of both come in the same order.
    """
    # On conditions.
    there = {condition(cell): place for place, cell in enumerate(reference.cells)}
    here = [place for place, cell in enumerate(cells.cells) if condition(cell) in there]
    own = cells.choose(here)
    other = reference.choose([there[condition(cell)] for cell in own.cells])
    # On worlds; nearly always they are the same.
    if not _same_worlds(own, other):
        names = np.unique(np.concatenate([own.worlds, other.worlds]))
        left = own.place * len(names) + np.searchsorted(names, own.worlds)
        right = other.place * len(names) + np.searchsorted(names, other.worlds)
        own = own.with_episodes(np.isin(left, right))
        other = other.with_episodes(np.isin(right, left))
    defined = ~np.isnan(own.pooled(name)) & ~np.isnan(other.pooled(name))
    return own.choose(defined), other.choose(defined)


def _same_worlds(one: CellTable, other: CellTable) -> bool:
    return np.array_equal(one.counts, other.counts) and np.array_equal(one.worlds, other.worlds)


def _median(values: Floats) -> float:
    defined = values[~np.isnan(values)]
    return float(np.median(defined)) if len(defined) else math.nan
