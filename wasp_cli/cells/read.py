"""Reads the cells of a results folder into one table, and says which are missing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import numpy as np
import pyarrow as pa

from wasp_cli.cells.cell import BRANCHES, RecordedCell
from wasp_cli.cells.kept_rows import KeptRows
from wasp_cli.cells.rows import CellRows, read_rows
from wasp_cli.cells.table import COLUMNS, EPISODE, WORLD, CellTable, Floats
from wasp_cli.errors import StoreError
from wasp_cli.store.branches import BRANCHES_FILE
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import AGAIN
from wasp_cli.store.tables import cell_file

Result = TypeVar("Result")

NOTHING: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Missing:
    """A cell, or its branches, without readable rows."""

    cell: RecordedCell
    reason: str
    label: str  # of what is missing, as reports print it
    damaged: bool = False  # whether its rows are there and do not read
    kind: str = KIND  # of the node that makes them
    invalid: bool = False  # whether a person marked it so

    @property
    def key(self) -> str:
        """The key of the artifact that is missing."""
        return self.cell.key if self.kind == KIND else self.cell.branches or ""


@dataclass(frozen=True, eq=False)
class CellsRead:
    """What was read of cells."""

    table: CellTable  # those that exist and can be read
    missing: tuple[Missing, ...]  # the others


def read_cells(
    layout: Layout, cells: Iterable[RecordedCell], absent: Mapping[str, str] = NOTHING
) -> CellsRead:
    """Read the cells that exist into one table; name those that do not, or that cannot be read.

    Args:
        layout: of the results folder.
        cells: in the order in which the table has them.
        absent: by key, why an artifact is not there, where that is known.
    """
    kept = KeptRows(layout)
    found: list[CellRows] = []
    missing: list[Missing] = []
    for cell in cells:
        rows = _read(layout, cell, absent, kept)
        if isinstance(rows, Missing):
            missing.append(rows)
        else:
            found.append(rows)
    kept.save()
    return CellsRead(table_of(found), tuple(missing))


def rows_of(layout: Layout, cell: RecordedCell) -> Path:
    """Return where the rows of a cell are, or would be. Raises StoreError where that leads out of
    the results folder.
    """
    return layout.within(cell_file(layout.artifact(KIND, cell.key)))


def read_or_missing(
    layout: Layout,
    cell: RecordedCell,
    kind: str,
    read: Callable[[Path], Result],
    absent: Mapping[str, str] = NOTHING,
) -> Result | Missing:
    """Read a table of a cell, of its rows or of its branches. A report names what is not there or
    damaged and goes on, and never averages without it in silence.
    """
    key = cell.key if kind == KIND else cell.branches or ""
    label = cell.title if kind == KIND else f"{kind} of {cell.title}"
    folder = layout.artifact(kind, key)
    path = folder / BRANCHES_FILE if kind == BRANCHES else cell_file(folder)
    try:
        layout.within(path)
    except StoreError as error:
        return Missing(cell, f"refused: {error.message}", label, kind=kind)
    if not path.exists():
        return Missing(cell, absent.get(key, "not computed yet"), label, kind=kind)
    try:
        with odd_tables_refused(path):
            return read(path)
    except StoreError as error:
        hint = f" ({error.hint})" if error.hint else ""
        return Missing(cell, f"{error.message}{hint}", label, damaged=True, kind=kind)


@contextmanager
def odd_tables_refused(path: Path) -> Iterator[None]:
    """Raise StoreError inside the block also for what `store.tables` never writes, but a
    Parquet file may hold.
    """
    try:
        if not path.is_file():  # a pipe would hold the reader for ever
            raise StoreError(f"{path} is no plain file")
        yield
    except (
        pa.ArrowException,
        ArithmeticError,
        AttributeError,
        LookupError,
        MemoryError,
        TypeError,
        ValueError,
    ) as error:
        what = " ".join(str(error).split())[:200]
        raise StoreError(f"{path} is not as wasp writes it: {what}", AGAIN) from error


def _read(
    layout: Layout, cell: RecordedCell, absent: Mapping[str, str], kept: KeptRows
) -> CellRows | Missing:
    def rows(path: Path) -> CellRows:
        found = kept.find(path, cell)
        if found is not None:
            return found
        found = read_rows(path, cell, COLUMNS)
        # an error where two worlds would become one number
        found.table["episode_seed"].cast(pa.float64())
        kept.add(path, found)
        return found

    return read_or_missing(layout, cell, KIND, rows, absent)


def table_of(found: Sequence[CellRows]) -> CellTable:
    """Return the rows of all cells as one table; each has at least COLUMNS."""
    if not found:
        names = (*COLUMNS[:-1], "jumps", WORLD, EPISODE)
        return CellTable((), (), {name: np.empty(0) for name in names})
    counts = [each.table.num_rows for each in found]
    rows = pa.concat_tables([each.table for each in found])
    columns = {name: _floats(rows[name].combine_chunks().cast(pa.float64())) for name in COLUMNS}
    columns["jumps"] = columns["decisions"] - 1.0  # T decisions have T - 1 changes
    columns[WORLD] = columns.pop("episode_seed")
    columns[EPISODE] = np.concatenate([np.arange(float(count)) for count in counts])
    return CellTable(
        [each.cell for each in found], counts, columns, [each.thresholds for each in found]
    )


def _floats(array: pa.Array) -> Floats:
    """[N] the numbers of a column, NaN where there is none. `to_numpy` would import pandas
    where that is installed: a third of a second.
    """
    known, numbers = array.buffers()
    values = np.frombuffer(numbers, np.float64, len(array), 8 * array.offset)
    if not array.null_count:
        return values
    bits = np.unpackbits(np.frombuffer(known, np.uint8), bitorder="little")
    valid = bits[array.offset :][: len(array)]
    return np.where(valid, values, np.nan)
