"""The rows of the cells of a results folder, kept between commands (`spec.kept`), so that the next
report opens one file instead of thousands.

    kept = KeptRows(layout)
    rows = kept.find(path, cell)      None: this cell has to be read from its own file
    kept.add(path, rows)
    kept.save()

What was kept of a cell counts only if its own file is still the same, by inode, size and times
(`artifact.stamp_of`). If nothing was kept, or if it is not as expected, every cell is read from its
own file.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import pyarrow as pa

from wasp_cli.cells import cell as cell_module
from wasp_cli.cells import rows as rows_module
from wasp_cli.cells import table as table_module
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.rows import CellRows
from wasp_cli.cells.table import COLUMNS
from wasp_cli.plan.index import is_settled, name_of
from wasp_cli.spec import kept
from wasp_cli.store import artifact, schema, tables
from wasp_cli.store.artifact import Stamp, stamp_of
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.schema import SCHEMA, CellIdentity, Thresholds
from wasp_cli.store.tables import cell_file

LEAST_NEW = 200
"""How many cells have to be new before the file is written again: reading fewer takes less time
than writing all.
"""

IDENTITY = tuple(field.name for field in fields(CellIdentity))
THRESHOLDS = tuple(field.name for field in fields(Thresholds))

ROWS = pa.schema([SCHEMA.field(name) for name in COLUMNS])
"""The episodes, cell after cell."""

CELLS = pa.schema(
    [
        pa.field("key", pa.string()),
        pa.field("inode", pa.uint64()),
        *(pa.field(name, pa.int64()) for name in ("size", "modified", "changed", "episodes")),
        *(pa.field(name, SCHEMA.field(name).type) for name in (*IDENTITY, *THRESHOLDS)),
    ]
)
"""The cells, a row each: the key, the stamp of the file, how many episodes follow, and what all
episodes have in common.
"""


@dataclass(frozen=True, eq=False)
class KeptCell:
    """The rows of one cell, and the stamp of the file that they were read from."""

    stamp: Stamp
    identity: CellIdentity
    thresholds: Thresholds
    table: pa.Table  # of ROWS


class KeptRows:
    """The rows that were kept of a results folder; there may be none."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._name = name_of("rows", layout)
        own = sys.modules[__name__]
        modules = (artifact, schema, tables, cell_module, rows_module, table_module, own)
        self._version = kept.code_version(*modules)
        self._cells = _unpacked(kept.read_kept_bytes(self._name, self._version))
        self._new = 0
        self._begun = time.time_ns()

    def find(self, path: Path, cell: RecordedCell) -> CellRows | None:
        """Return the rows of a cell as its file has them; None where they were not kept, or where
        the file is another one by now.

        Args:
            path: of its table of episodes.
            cell: which it should be.
        """
        known = self._cells.get(cell.key)
        if known is None or known.identity != cell.identity or known.stamp != stamp_of(str(path)):
            return None
        return CellRows(cell, known.thresholds, known.table)

    def add(self, path: Path, rows: CellRows) -> None:
        """Keep rows that were just read from the file at `path`."""
        stamp = stamp_of(str(path))
        if stamp is None or not is_settled(stamp, self._begun):
            return
        table = rows.table
        if table.schema.names != ROWS.names or table.schema.types != ROWS.types:
            return
        self._cells[rows.cell.key] = KeptCell(stamp, rows.cell.identity, rows.thresholds, table)
        self._new += 1

    def save(self) -> None:
        """Write the file again if many cells are new; cells that were removed leave it."""
        if self._new < LEAST_NEW:
            return
        present = {key: known for key, known in self._cells.items() if self._exists(key)}
        kept.keep_bytes(self._name, self._version, _packed(present))
        self._new = 0

    def _exists(self, key: str) -> bool:
        return stamp_of(str(cell_file(self._layout.artifact(KIND, key)))) is not None


def _packed(cells: Mapping[str, KeptCell]) -> bytes:
    """The table of cells, and after it the table of their rows."""
    records = []
    for key, known in cells.items():
        numbers = (*known.stamp, known.table.num_rows)
        values = (key, *numbers, *astuple(known.identity), *astuple(known.thresholds))
        records.append(dict(zip(CELLS.names, values, strict=True)))
    rows = pa.concat_tables([known.table.cast(ROWS) for known in cells.values()])
    sink = pa.BufferOutputStream()
    options = pa.ipc.IpcWriteOptions(compression="lz4")
    for table in (pa.Table.from_pylist(records, CELLS), rows.combine_chunks()):
        with pa.ipc.new_stream(sink, table.schema, options=options) as writer:
            writer.write_table(table)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _unpacked(content: bytes | None) -> dict[str, KeptCell]:
    """The cells by key, as `_packed` was given them; none where there is no content, or where its
    columns are not today's: other modules may have added a measure.
    """
    if content is None:
        return {}
    source = pa.BufferReader(content)
    cells = pa.ipc.open_stream(source).read_all()
    rows = pa.ipc.open_stream(source).read_all()
    if not cells.schema.equals(CELLS) or not rows.schema.equals(ROWS):
        return {}
    columns = [cells[name].to_pylist() for name in CELLS.names]
    found = {}
    first = 0
    for key, inode, size, modified, changed, episodes, *values in zip(*columns, strict=True):
        identity = CellIdentity(*values[: len(IDENTITY)])
        thresholds = Thresholds(*values[len(IDENTITY) :])
        own = rows.slice(first, episodes)
        found[key] = KeptCell((inode, size, modified, changed), identity, thresholds, own)
        first += episodes
    return found
