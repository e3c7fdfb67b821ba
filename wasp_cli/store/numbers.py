"""Some episode columns of a cell, and what all its rows share, for a reader of thousands of cells.

    found = read_numbers(path, ("return", "cost"))
    found.identity, found.thresholds, found.table

For a file that is not exactly as `store.tables` writes it, the result is None: read it with
`tables.read_episodes`, which raises what is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from wasp_cli.errors import StoreError
from wasp_cli.store.parquet import opened_table
from wasp_cli.store.schema import (
    OLDEST,
    SCHEMA,
    VERSION,
    VERSION_KEY,
    CellIdentity,
    Thresholds,
)
from wasp_cli.store.tables import columns_of

SHARED = (*CellIdentity.__dataclass_fields__, *Thresholds.__dataclass_fields__)
"""Columns with one value in all rows of a cell."""


class Numbers(NamedTuple):
    """Some columns of a cell, and the values that all its rows share."""

    identity: CellIdentity
    thresholds: Thresholds
    table: pa.Table  # the columns that were asked for


def read_numbers(path: Path, columns: Sequence[str]) -> Numbers | None:
    """Read some columns of a cell, checked against their checksums, and what its rows share; None
    where anything in the file is unexpected.
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
    columns_found = [(column.name, column.type) for column in table.schema]
    columns_expected = [(name, SCHEMA.field(name).type) for name in every]
    if table.num_rows == 0 or columns_found != columns_expected:
        return None
    # From the rows, and not from the statistics of the footer: of a damaged one, asking for these
    # can end the whole process.
    shared: dict[str, Any] = {}
    for name in SHARED:
        values = table[name].unique().to_pylist()
        if len(values) != 1 or values[0] != values[0]:  # NaN is no threshold
            return None
        shared[name] = values[0]
    thresholds = Thresholds(**{name: shared.pop(name) for name in Thresholds.__dataclass_fields__})
    return Numbers(CellIdentity(**shared), thresholds, table.select(list(columns)))
