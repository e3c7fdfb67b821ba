"""How large a table may be before anybody reads it: a few bytes of Parquet can stand for any number of rows.

    require_size(path)     of a cell's episodes, with the steps beside them, or of another table

Read is the footer alone.
"""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.errors import StoreError
from wasp_cli.store.tables import EPISODES_FILE, STEPS_FILE

MOST_EPISODES = 100_000
"""Rows of a cell: a spec cannot ask for more episodes."""
MOST_VALUES = 2**27
"""Numbers of a table in all, a gigabyte: a thousand episodes of a thousand decisions have half as many in their steps."""
HINT = "no plan writes so many: remove the folder, and run the spec again"


def require_size(path: Path) -> None:
    """See that a table, and the steps beside it where it is that of a cell, can be what a run has written.

    Args:
        path: a plain file.

    Raises:
        StoreError: there are more rows or numbers than a plan can have. What is no Parquet file at all is for its reader to say.
    """
    cell = path.name == EPISODES_FILE
    _require(path, MOST_EPISODES if cell else None)
    steps = path.with_name(STEPS_FILE)
    if cell and steps.is_file() and not steps.is_symlink():
        _require(steps, None)


def values_of(footer: pq.FileMetaData) -> int:
    """Return how many numbers a file holds at most by its footer: a row has one for each column, or its bytes divided by those of a number.

    Of row groups as a whole: asked for a column whose type a flipped bit has changed, pyarrow ends the process.
    """
    sizes = sum(footer.row_group(i).total_byte_size for i in range(footer.num_row_groups))
    return int(max(footer.num_rows * footer.num_columns, sizes // 8))


def _require(path: Path, most_rows: int | None) -> None:
    try:
        footer = pq.read_metadata(path)
        rows, values = footer.num_rows, values_of(footer)
    except (pa.ArrowException, OSError, ValueError):
        return
    if most_rows is not None and rows > most_rows:
        raise StoreError(f"{path} has {rows:,} rows, and a cell has at most {most_rows:,} episodes", HINT)
    if values > MOST_VALUES:
        raise StoreError(f"{path} has {rows:,} rows with {values:,} numbers, more than the {MOST_VALUES:,} that are read", HINT)
