"""The rows of all cells of a report in one file: opening 5,000 files takes as long as all tables together.

    kept = read_kept(path)          {} where there is no such file, or it is of no use
    kept[place_of(cell)]            a cell as it was read, with the stamp that its file had then
    write_kept(path, cells)

The file is a cache, as `store.index` is. A cell counts as long as its own file has the time and the size that it had when it was read with
its checksums; a cache that is removed, damaged or not writable costs time and nothing else.
"""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.errors import StoreError
from wasp_cli.store.bounds import MOST_VALUES, values_of
from wasp_cli.store.numbers import Numbers
from wasp_cli.store.parquet import opened_table
from wasp_cli.store.tables import SCHEMA, CellIdentity, Thresholds

VERSION = 1
VERSION_KEY, CELLS_KEY = b"wasp.kept", b"wasp.kept_cells"

Stamp = tuple[int, int]
"""Time in nanoseconds and size of a file."""


class Kept(NamedTuple):
    """A cell, and the file that it was read from."""

    place: str
    stamp: Stamp
    numbers: Numbers


def place_of(path: Path) -> str:
    """Name the file of a cell: its key, and its name."""
    return f"{path.parent.name}/{path.name}"


def stamp_of(path: Path) -> Stamp:
    """Return the stamp of a file as it is now."""
    state = os.stat(path)
    return state.st_mtime_ns, state.st_size


def read_kept(path: Path, columns: Sequence[str]) -> dict[str, Kept]:
    """Read every kept cell, by place; empty where the file does not have these columns as they are written today, or has other faults."""
    if not path.is_file() or path.is_symlink():
        return {}
    try:
        with opened_table(path, VERSION_KEY, VERSION, "the kept rows of a report") as file:
            if file.schema_arrow.names != list(columns):
                return {}
            if values_of(file.metadata) > MOST_VALUES:
                return {}
            cells = json.loads(file.schema_arrow.metadata[CELLS_KEY])
            table = file.read().combine_chunks()
        return _of_cells(table, cells)
    except (StoreError, pa.ArrowException, ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RecursionError):
        return {}


def _of_cells(table: pa.Table, cells: Sequence[Mapping[str, Any]]) -> dict[str, Kept]:
    if [field.type for field in table.schema] != [SCHEMA.field(name).type for name in table.column_names]:
        return {}
    found: dict[str, Kept] = {}
    begin = 0
    for cell in cells:
        place, (time, size), rows, identity, thresholds = (cell[name] for name in ("place", "stamp", "rows", "identity", "thresholds"))
        if type(rows) is not int or rows < 1:
            return {}
        numbers = Numbers(CellIdentity(**identity), Thresholds(**thresholds), table.slice(begin, rows))
        found[str(place)] = Kept(str(place), (time, size), numbers)
        begin += rows
    return found if begin == table.num_rows else {}


def write_kept(path: Path, cells: Sequence[Kept]) -> None:
    """Write the cells for the next report, in one step; a folder that cannot be written is none of a report's business."""
    facts = [
        {
            "place": cell.place, "stamp": cell.stamp, "rows": cell.numbers.table.num_rows,
            "identity": asdict(cell.numbers.identity), "thresholds": asdict(cell.numbers.thresholds),
        }
        for cell in cells
    ]  # fmt: skip
    marks = {VERSION_KEY: str(VERSION), CELLS_KEY: json.dumps(facts)}
    table = pa.concat_tables([cell.numbers.table.replace_schema_metadata(None) for cell in cells]).replace_schema_metadata(marks)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}-{uuid.uuid4().hex[:8]}")
        try:
            with part.open("xb") as file:
                pq.write_table(table, file, compression="snappy", use_dictionary=False, write_page_checksum=True)
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
