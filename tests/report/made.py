"""Tables of cells from numbers, without any file."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.table import CellTable
from wasp_cli.report.stats import Frame
from wasp_cli.store.tables import CellIdentity

NO_CELLS = CellTable((), (), {})


def one_cell(
    identity: CellIdentity, worlds: Sequence[float], severity: str | None = "mild", **columns: Any
) -> CellTable:
    """A table of one cell with its columns; each episode has one decision unless they say so."""
    cell = RecordedCell(**vars(identity), key=f"{abs(hash(identity)):020x}"[:20], severity=severity)
    every = {"world": worlds, "decisions": np.ones(len(worlds)), **columns}
    arrays = {name: np.asarray(values, np.float64) for name, values in every.items()}
    return CellTable([cell], [len(worlds)], arrays)


def singles(table: CellTable) -> list[CellTable]:
    """Each cell as a table of its own."""
    return [table.choose([place]) for place in range(len(table))]


def renamed(table: CellTable, name: Callable[[RecordedCell], dict[str, Any]]) -> CellTable:
    """The same numbers, of cells that are called otherwise."""
    cells = [replace(cell, **name(cell)) for cell in table]
    columns = {column: table.episodes(column) for column in table.names}
    return CellTable(cells, table.counts, columns, table.thresholds)


def frame_of_tables(*tables: CellTable) -> Frame:
    """A report of the cells of several tables, all of which are there."""
    table = CellTable.joined(tables)
    return Frame(table, (), table.cells)
