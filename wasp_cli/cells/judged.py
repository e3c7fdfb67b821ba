"""The counterfactual branches of cells, and what they say of their interventions as columns of the
table of cells.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.cell import BRANCHES, RecordedCell
from wasp_cli.cells.read import NOTHING, Missing, read_or_missing
from wasp_cli.cells.table import JUDGED, WEIGHT_OF, CellTable, Floats
from wasp_cli.metrics.necessity import ALONE, ASSISTED, Necessity, necessity
from wasp_cli.store.branches import read_branches
from wasp_cli.store.layout import Layout


@dataclass(frozen=True, eq=False)
class Judged:
    """The branched interventions of a cell."""

    worth: Necessity
    episode: NDArray[np.int64]  # [N] of each
    window: int  # W
    tau_R: float

    def of_episodes(self, kept: NDArray[np.bool_]) -> Judged:
        """Return the interventions of some episodes (a mask over those of the cell), which are
        numbered anew, as the rows of the cell are.
        """
        here = kept[self.episode]
        numbers = np.cumsum(kept) - 1
        worth = {name: part[here] for name, part in self.worth._asdict().items()}
        return Judged(Necessity(**worth), numbers[self.episode[here]], self.window, self.tau_R)


@dataclass(frozen=True, eq=False)
class BranchesRead:
    """What was read of the branches of cells."""

    judged: Mapping[str, Judged]  # by key of the cell
    missing: tuple[Missing, ...]  # the branches that were asked for and cannot be read


def read_judged(
    layout: Layout, table: CellTable, absent: Mapping[str, str] = NOTHING
) -> BranchesRead:
    """Read the branches of the cells of a table that have some; `absent` is as of `read_cells`."""
    judged: dict[str, Judged] = {}
    missing: list[Missing] = []
    for cell, count in zip(table.cells, table.counts, strict=True):
        if cell.branches is None:
            continue
        found = _read(layout, cell, int(count), absent)
        if isinstance(found, Missing):
            missing.append(found)
        else:
            judged[cell.key] = found
    return BranchesRead(judged, tuple(missing))


def with_judged(table: CellTable, judged: Mapping[str, Judged]) -> CellTable:
    """Return a table with JUDGED and their weights as columns; NaN, and no weight, in the cells
    without branches.

    An episode's number is the mean over its branched interventions, undefined where there are none;
    so is that of a cell.
    """
    total = len(table.place)
    columns = {name: np.full(total, np.nan) for name in JUDGED}
    weights = {str(WEIGHT_OF[name]): np.zeros(total) for name in JUDGED}
    for place, cell in enumerate(table.cells):
        if cell.key not in judged:
            continue
        rows = table.rows_of(place)
        episodes = int(table.counts[place])
        of_cell = judged[cell.key]
        for name, every in numbers_of(of_cell.worth).items():
            defined = ~np.isnan(every)
            episode = of_cell.episode[defined]
            count = np.bincount(episode, minlength=episodes).astype(np.float64)
            sums = np.bincount(episode, every[defined], episodes)
            np.divide(sums, count, out=columns[name][rows], where=count > 0)
            weights[str(WEIGHT_OF[name])][rows] = count
    return table.with_columns({**columns, **weights})


def numbers_of(worth: Necessity) -> dict[str, Floats]:
    """Return [N] per column of JUDGED: one number for each branched intervention, NaN where it does
    not count.
    """
    unnecessary = worth.unnecessary.astype(np.float64)
    return {
        "uir": unnecessary,
        "uir_swapped": worth.swapped.astype(np.float64),
        "uir_eff": np.where(worth.effective, unnecessary, np.nan),
        "rho": worth.rho,
        "at_risk": (worth.rho > 0.0).astype(np.float64),
        "delta_c": worth.delta_c,
        "delta_r": worth.delta_r,
    }


def _read(
    layout: Layout, cell: RecordedCell, episodes: int, absent: Mapping[str, str]
) -> Judged | Missing:
    def worth(path: Path) -> Judged:
        stored = read_branches(path)
        if stored.cell.identity != cell.identity:
            raise ValueError(f"it holds the branches of another cell: {stored.cell.identity}")
        outside = (stored.episode < 0) | (stored.episode >= episodes)
        if stored.cell.episodes != episodes or outside.any():
            raise ValueError(
                f"it is about {stored.cell.episodes} episodes, and the cell has {episodes}"
            )
        # Eq. 19-21
        of_branches = necessity(
            stored.cost[ALONE],
            stored.cost[ASSISTED],
            stored.reward[ALONE],
            stored.reward[ASSISTED],
            stored.cell.tau_R,
        )
        return Judged(of_branches, stored.episode, stored.cell.window, stored.cell.tau_R)

    return read_or_missing(layout, cell, BRANCHES, worth, absent)
