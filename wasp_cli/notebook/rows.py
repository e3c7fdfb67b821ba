"""Tables of many cells, one below the other: each row begins with the key, the spec and the names of its cell."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa

from wasp_cli.errors import StoreError
from wasp_cli.metrics.necessity import ALONE, ASSISTED, necessity
from wasp_cli.notebook.cells import BRANCHES, ListedCell, table_of
from wasp_cli.store.bounds import require_size
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import AGAIN
from wasp_cli.store.tables import METRICS, STEP, THRESHOLDS, TIMES, CellIdentity, read_episodes, read_steps

NAMES = pa.schema(
    [
        *((name, pa.string()) for name in ("key", "spec", "task", "method", "variant", "operator", "severity")),
        ("value", pa.float64()),
        ("seed", pa.int64()),
    ]
)
"""Columns with which every row begins: fields of `ListedCell`."""
EPISODE = (pa.field("episode", pa.int32()), pa.field("episode_seed", pa.int64()), *METRICS, *THRESHOLDS, *TIMES)
STEPS = (pa.field("episode", pa.int32()), *STEP)
SUMS = ("cost_assisted", "cost_alone", "reward_assisted", "reward_alone", "rho", "delta_c", "delta_r")
BRANCH = (
    pa.field("episode", pa.int32()),
    pa.field("t", pa.int32()),
    pa.field("gate", pa.int8()),
    pa.field("deviation", pa.float32()),
    *(pa.field(name, pa.float64()) for name in SUMS),
    *(pa.field(name, pa.bool_()) for name in ("unnecessary", "unnecessary_swapped", "effective")),
    pa.field("window", pa.int16()),
    pa.field("tau_R", pa.float64()),
)
"""A branched decision: sums of cost and reward over the window of both branches, and what `metrics.necessity` says of them."""

THREADS = 4  # that read cells side by side

Read = Callable[[Layout, ListedCell], pa.Table | None]
"""Reads the rows of one cell; None where it is not computed."""


def stacked(layout: Layout, cells: Sequence[ListedCell], read: Read, fields: Sequence[pa.Field], columns: Iterable[str] | None) -> pa.Table:
    """Read columns of many cells into one table, in the order of the cells; those that are not computed have no rows."""
    known = {field.name: field for field in fields}
    asked = list(known if columns is None else dict.fromkeys(columns))
    for name in asked:
        if name not in known and name not in NAMES.names:
            raise KeyError(f"no column '{name}'; there are {', '.join(known)}")
    kept = [known[name].with_nullable(True) for name in asked if name in known]
    schema = pa.schema([*NAMES, *kept])

    def one(cell: ListedCell) -> pa.Table | None:
        rows = read(layout, cell)
        if rows is None:
            return None
        named = [pa.repeat(pa.scalar(getattr(cell, field.name), field.type), rows.num_rows) for field in NAMES]
        return pa.table([*named, *(rows[field.name].cast(field.type) for field in kept)], schema=schema)

    with ThreadPoolExecutor(THREADS) as threads:
        tables = [table for table in threads.map(one, cells) if table is not None]
    return pa.concat_tables(tables).combine_chunks() if tables else schema.empty_table()


def episodes(layout: Layout, cell: ListedCell) -> pa.Table | None:
    """Read the episodes of a cell."""
    path = table_of(layout, cell)
    return None if path is None else _own_episodes(path, cell)


def _own_episodes(path: Path, cell: ListedCell) -> pa.Table:
    require_size(path)
    table = read_episodes([path])
    names = CellIdentity.__dataclass_fields__
    if table.num_rows and {name: table[name][0].as_py() for name in names} != asdict(cell.identity):
        raise StoreError(f"{path} holds another cell than {cell.label}", AGAIN)
    return table


def steps(layout: Layout, cell: ListedCell) -> pa.Table | None:
    """Read the steps of a cell."""
    path = table_of(layout, cell)
    if path is None:
        return None
    _own_episodes(path, cell)
    return read_steps(path)


def branches(layout: Layout, cell: ListedCell) -> pa.Table | None:
    """Read the branched decisions of a cell."""
    if cell.branches is None:
        return None
    path = layout.within(layout.artifact(BRANCHES, cell.branches) / BRANCHES_FILE)
    if not path.is_file():
        return None
    require_size(path)
    found = read_branches(path)
    if found.cell.identity != cell.identity:
        raise StoreError(f"{path} holds the branches of another cell than {cell.label}", AGAIN)
    cost, reward, count = found.cost, found.reward, len(found.episode)
    worth = necessity(cost[ALONE], cost[ASSISTED], reward[ALONE], reward[ASSISTED], found.cell.tau_R)
    columns = {
        "episode": found.episode, "t": found.t, "gate": found.gate, "deviation": found.deviation,
        "cost_assisted": cost[ASSISTED].sum(1), "cost_alone": cost[ALONE].sum(1),
        "reward_assisted": reward[ASSISTED].sum(1), "reward_alone": reward[ALONE].sum(1),
        "rho": worth.rho, "delta_c": worth.delta_c, "delta_r": worth.delta_r, "unnecessary": worth.unnecessary,
        "unnecessary_swapped": worth.swapped, "effective": worth.effective,
        "window": np.full(count, found.cell.window), "tau_R": np.full(count, found.cell.tau_R),
    }  # fmt: skip
    return pa.table({field.name: pa.array(columns[field.name]).cast(field.type) for field in BRANCH})
