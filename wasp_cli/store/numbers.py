"""Some episode columns of a cell, and what all its rows share, for a reader of thousands of cells.

    found = read_numbers(path, ("return", "cost"))
    found.identity, found.thresholds, found.table

A file that is not quite as `store.tables` writes it today gives None: it is for
`tables.read_episodes` to read it, or to say what is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from wasp_cli.errors import StoreError
from wasp_cli.store.parquet import opened_table
from wasp_cli.store.tables import (
    OLDEST,
    SCHEMA,
    VERSION,
    VERSION_KEY,
    CellIdentity,
    Thresholds,
    columns_of,
)

SHARED = tuple(name for kind in (CellIdentity, Thresholds) for name in kind.__dataclass_fields__)
"""Columns with one value in all rows of a cell."""


class Numbers(NamedTuple):
    """What a cell file says of its episodes."""

    identity: CellIdentity
    thresholds: Thresholds
    table: pa.Table  # the columns that were asked for


def read_numbers(path: Path, columns: Sequence[str]) -> Numbers | None:
    """Read some columns of a cell, checked against their checksums, and what its rows share;
    None where the file needs a closer look.
    """
    every = [*SHARED, *columns]
    try:
        with opened_table(path, VERSION_KEY, VERSION, "the table of a cell") as file:
            version = int(file.schema_arrow.metadata[VERSION_KEY])
            if version < OLDEST or file.num_row_groups != 1:
                return None
            table = columns_of(file, every, version)
    except (StoreError, ArithmeticError, AttributeError):
        return None
    # pyarrow leaves out, without a word, a column that the footer does not name.
    if table.num_rows == 0 or [(column.name, column.type) for column in table.schema] != [
        (n, SCHEMA.field(n).type) for n in every
    ]:
        return None
    # From the rows: pyarrow ends the whole process over some footers of which it is asked for the
    # statistics.
    values = {name: table[name].unique().to_pylist() for name in SHARED}
    # NaN is no threshold
    if any(len(different) != 1 or different[0] != different[0] for different in values.values()):
        return None
    shared = {name: value for name, (value,) in values.items()}
    thresholds = Thresholds(**{name: shared.pop(name) for name in Thresholds.__dataclass_fields__})
    return Numbers(CellIdentity(**shared), thresholds, table.select(list(columns)))
