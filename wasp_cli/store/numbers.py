"""Some episode columns of a cell, and what all its rows share, for a reader of thousands of cells.

    found = read_numbers(path, ("return", "cost"))
    found.identity, found.thresholds, found.table

A file that is not quite as `store.tables` writes it today gives None: it is for `tables.read_episodes` to read it, or to say what is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.store.tables import OLDEST, SCHEMA, VERSION, VERSION_KEY, CellIdentity, Thresholds, columns_of

ALIKE = {str(version).encode(): version for version in range(OLDEST, VERSION + 1)}
"""Versions whose episode columns are those of `tables.SCHEMA` but for names and what they lack."""

SHARED = tuple(name for kind in (CellIdentity, Thresholds) for name in kind.__dataclass_fields__)
"""Columns with one value in all rows of a cell."""


class Numbers(NamedTuple):
    """What a cell file says of its episodes."""

    identity: CellIdentity
    thresholds: Thresholds
    table: pa.Table  # the columns that were asked for


def read_numbers(path: Path, columns: Sequence[str]) -> Numbers | None:
    """Read some columns of a cell, checked against their checksums, and what its rows share; None where the file needs a closer look."""
    every = [*SHARED, *columns]
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            version = ALIKE.get((file.schema_arrow.metadata or {}).get(VERSION_KEY, b""))
            if version is None or file.num_row_groups != 1:
                return None
            table = columns_of(file, every, version)
    except (pa.ArrowException, OSError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        return None
    # pyarrow leaves out, without a word, a column that the footer does not name.
    if table.num_rows == 0 or [(column.name, column.type) for column in table.schema] != [(n, SCHEMA.field(n).type) for n in every]:
        return None
    shared = _shared(table)
    if shared is None:
        return None
    thresholds = Thresholds(**{name: shared.pop(name) for name in Thresholds.__dataclass_fields__})
    return Numbers(CellIdentity(**shared), thresholds, table.select(list(columns)))


def _shared(table: pa.Table) -> dict[str, Any] | None:
    """SHARED of some rows; None unless all rows have the same.

    From the rows: pyarrow ends the whole process over some footers of which it is asked for the statistics.
    """
    shared: dict[str, Any] = {}
    for name in SHARED:
        values = table[name].unique().to_pylist()
        if len(values) != 1 or values[0] != values[0]:  # NaN is no threshold
            return None
        shared[name] = values[0]
    return shared
