"""Reads the rows of one cell: some columns of its episodes, and the thresholds in force.

    found = read_rows(path, cell, ("return", "cost"))
    found.thresholds, found.table

A report reads thousands of cells so. A file that is exactly as `store.tables` writes it today is
read at once; any other is read closely, which takes longer and says what is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.errors import StoreError
from wasp_cli.store.parquet import AGAIN
from wasp_cli.store.schema import OLDEST, SCHEMA, VERSION, VERSION_KEY, CellIdentity, Thresholds
from wasp_cli.store.tables import columns_of, lacking, read_episodes, read_version

IDENTITY = tuple(field.name for field in fields(CellIdentity))
THRESHOLDS = tuple(field.name for field in fields(Thresholds))
SHARED = (*IDENTITY, *THRESHOLDS)
"""Columns with one value in all rows of a cell."""

AT_ONCE = 2**26
"""Bytes of a file that is read as a whole, at most. A cell of 200 episodes has some 20 kB."""

UNEXPECTED = (
    pa.ArrowException,
    ArithmeticError,
    AttributeError,
    LookupError,
    OSError,
    TypeError,
    ValueError,
)
"""What reading raises where a file is not as it was written."""


@dataclass(frozen=True, eq=False)
class CellRows:
    """The episodes of one cell, as they are stored."""

    cell: RecordedCell
    thresholds: Thresholds
    table: pa.Table  # a row per episode, with the columns that were asked for


def read_rows(path: Path, cell: RecordedCell, columns: Sequence[str]) -> CellRows:
    """Read some columns of the episodes of a cell, checked against their checksums.

    Args:
        path: of its table of episodes.
        cell: which it should be.
        columns: of `store.schema.SCHEMA`. Those that the version of the file lacks are null.

    Raises:
        StoreError: the file is damaged, has no episodes, or holds another cell.
    """
    table = _read_at_once(path, columns)
    shared = None if table is None else _shared_values(table)
    if table is None or shared is None:
        table = _read_closely(path)
        shared = table.slice(0, 1).select(SHARED).to_pylist()[0]
    identity = CellIdentity(**{name: shared[name] for name in IDENTITY})
    if identity != cell.identity:
        raise StoreError(f"{path} holds another cell than {cell.label}: {identity}", AGAIN)
    thresholds = Thresholds(**{name: shared[name] for name in THRESHOLDS})
    return CellRows(cell, thresholds, table.select(columns))


def _read_at_once(path: Path, columns: Sequence[str]) -> pa.Table | None:
    """SHARED and the columns; None where anything in the file is unexpected."""
    every = list(dict.fromkeys((*SHARED, *columns)))
    try:
        if path.stat().st_size > AT_ONCE:
            return None
        # From memory: of a file pyarrow reads every column by itself, on threads of its own, which
        # takes twice as long.
        whole = pa.BufferReader(path.read_bytes())
        with pq.ParquetFile(whole, page_checksum_verification=True) as file:
            version = int(file.schema_arrow.metadata[VERSION_KEY])
            if not OLDEST <= version <= VERSION or file.num_row_groups != 1:
                return None
            table = columns_of(file, every, version)
    except UNEXPECTED:
        return None
    # pyarrow leaves out, without a word, a column that the footer does not name.
    columns_found = [(column.name, column.type) for column in table.schema]
    columns_expected = [(name, SCHEMA.field(name).type) for name in every]
    if table.num_rows == 0 or columns_found != columns_expected:
        return None
    return table


def _shared_values(table: pa.Table) -> dict[str, Any] | None:
    """The value of each of SHARED; None where one of them has several, or is NaN."""
    # From the rows, and not from the statistics of the footer: of a damaged one, asking for these
    # can end the whole process.
    shared: dict[str, Any] = {}
    for name in SHARED:
        values = table[name].unique().to_pylist()
        if len(values) != 1 or values[0] != values[0]:
            return None
        shared[name] = values[0]
    return shared


def _read_closely(path: Path) -> pa.Table:
    """All columns, also of an older version; an error says what is wrong with a damaged file."""
    try:
        table = read_episodes([path])
    except ValueError as error:  # its columns are not those of a cell
        there = pq.read_schema(path).names
        known = (*there, *lacking(read_version(path)))
        absent = ", ".join(name for name in SCHEMA.names if name not in known)
        what = f"it has no column {absent}" if absent else str(error)
        raise StoreError(f"{path} is damaged: {what}", AGAIN) from error
    if table.num_rows == 0:
        raise StoreError(f"{path} has no episodes")
    if any(len(table[name].unique()) > 1 for name in IDENTITY):
        raise StoreError(f"{path} is damaged: its rows are of several cells", AGAIN)
    return table
