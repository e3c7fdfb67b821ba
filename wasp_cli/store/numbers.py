"""The episode columns of a cell for a reader of thousands of cells: what all rows share comes from the footer, not from the rows.

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

from wasp_cli.store.bounds import MOST_EPISODES
from wasp_cli.store.tables import LAST_NESTED, SCHEMA, VERSION, VERSION_KEY, CellIdentity, Thresholds

ALIKE = tuple(str(version).encode() for version in (LAST_NESTED, VERSION))
"""Versions whose episode columns are those of `tables.SCHEMA`, at the same places."""

SHARED = tuple(name for kind in (CellIdentity, Thresholds) for name in kind.__dataclass_fields__)
"""Columns with one value in all rows of a cell."""


class Numbers(NamedTuple):
    """What a cell file says of its episodes."""

    identity: CellIdentity
    thresholds: Thresholds
    table: pa.Table
    """the columns that were asked for"""


def read_numbers(path: Path, columns: Sequence[str]) -> Numbers | None:
    """Read some columns of a cell, checked against their checksums, and what its rows share; None where the file needs a closer look.

    Args:
        path: a file, no pipe.
        columns: of `tables.SCHEMA`, each with one number per episode.
    """
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            if (
                (file.schema_arrow.metadata or {}).get(VERSION_KEY) not in ALIKE
                or file.num_row_groups != 1
                or file.metadata.num_rows > MOST_EPISODES
            ):
                return None
            shared = _shared(file.metadata.row_group(0))
            table = file.read(columns=list(columns), use_threads=False)
    except (pa.ArrowException, OSError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        return None
    if (
        shared is None
        or table.num_rows == 0
        or [field.type for field in table.schema] != [SCHEMA.field(name).type for name in table.column_names]
    ):
        return None
    thresholds = Thresholds(**{name: shared.pop(name) for name in Thresholds.__dataclass_fields__})
    return Numbers(CellIdentity(**shared), thresholds, table)


def _shared(group: Any) -> dict[str, Any] | None:
    """SHARED of a row group, from the least and the greatest value of each; None unless they are known to be the same."""
    found: dict[str, Any] = {}
    for name in SHARED:
        column = group.column(SCHEMA.get_field_index(name))
        known = column.statistics
        if column.path_in_schema != name or known is None or not known.has_null_count:
            return None
        if known.null_count == group.num_rows:
            found[name] = None
        elif known.null_count == 0 and known.has_min_max and known.min == known.max:
            found[name] = known.max
        else:
            return None
    return found
