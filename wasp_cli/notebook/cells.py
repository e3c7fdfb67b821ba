"""Results and trained parts in one line, for notebooks and scripts: which cells a results folder
has, and their rows below each other.

The plans of its runs alone say which cells there are: no spec is parsed, no plugin imported. Each
row begins with the key, the spec and the names of its cell.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from wasp_cli.cells.cell import BRANCHES, RecordedCell
from wasp_cli.cells.read import rows_of
from wasp_cli.cells.rows import read_rows
from wasp_cli.cells.runs import RunRecord
from wasp_cli.errors import StoreError, UnknownName
from wasp_cli.metrics.necessity import ALONE, ASSISTED, necessity
from wasp_cli.store.artifact import stored_keys, stored_kinds
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.parquet import AGAIN
from wasp_cli.store.tables import (
    METRICS,
    STEP,
    THRESHOLDS,
    TIMES,
    read_steps,
)

T = TypeVar("T")
Names = str | Iterable[str] | None
Numbers = float | Iterable[float] | None  # one value, several, or None for all


def chosen(items: Sequence[T], wanted: Mapping[str, Any]) -> list[T]:
    """Keep what has one of the wanted values in each field that is not None.

    UnknownName where nothing has a value: a misspelt method gives no empty table.
    """
    kept = list(items)
    for name, value in wanted.items():
        if value is None:
            continue
        known = {getattr(item, name) for item in items}
        texts = {str(one): one for one in known if one is not None}
        # a number may be written as a text
        values = {texts.get(str(one), one) for one in _values(value)}
        for unknown in sorted(values - known, key=str):
            raise UnknownName(f"{name} in these results", str(unknown), texts)
        kept = [item for item in kept if getattr(item, name) in values]
    return kept


def _values(value: Any) -> Iterator[Any]:
    if isinstance(value, str) or not isinstance(value, Iterable):
        yield value
    else:
        yield from value


def table_of(layout: Layout, cell: RecordedCell) -> Path | None:
    """Return where the rows of a cell are; None where it is not computed."""
    path = rows_of(layout, cell)
    return path if path.is_file() else None


NAMES = pa.schema(  # columns with which every row begins: fields of `RecordedCell`
    [
        *(
            (name, pa.string())
            for name in ("key", "spec", "task", "method", "variant", "operator", "severity")
        ),
        ("value", pa.float64()),
        ("seed", pa.int64()),
    ]
)
EPISODE = (
    pa.field("episode", pa.int32()),
    pa.field("episode_seed", pa.int64()),
    *METRICS,
    *THRESHOLDS,
    *TIMES,
)
STEPS = (pa.field("episode", pa.int32()), *STEP)
SUMS = (
    "cost_assisted",
    "cost_alone",
    "reward_assisted",
    "reward_alone",
    "rho",
    "delta_c",
    "delta_r",
)
# a branched decision: sums of cost and reward over the window of both branches, and what
# `metrics.necessity` says of them
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

# reads the rows of one cell; None where it is not computed
Read = Callable[[Layout, RecordedCell], pa.Table | None]


def stacked(
    layout: Layout,
    cells: Sequence[RecordedCell],
    read: Read,
    fields: Sequence[pa.Field],
    columns: Iterable[str] | None,
) -> pa.Table:
    """Read columns of many cells into one table, in the order of the cells; those that are not
    computed have no rows.
    """
    known = {field.name: field for field in fields}
    asked = list(known if columns is None else dict.fromkeys(_values(columns)))
    for name in asked:
        if name not in known and name not in NAMES.names:
            raise KeyError(f"no column '{name}'; there are {', '.join(known)}")
    kept = [known[name].with_nullable(True) for name in asked if name in known]
    schema = pa.schema([*NAMES, *kept])

    tables: list[pa.Table] = []
    for cell in cells:
        rows = read(layout, cell)
        if rows is None:
            continue
        columns_of_cell = []
        for field in NAMES:
            value = pa.scalar(getattr(cell, field.name), field.type)
            columns_of_cell.append(pa.repeat(value, rows.num_rows))
        for field in kept:
            columns_of_cell.append(rows[field.name].cast(field.type))
        tables.append(pa.table(columns_of_cell, schema=schema))
    if not tables:
        return schema.empty_table()
    return pa.concat_tables(tables).combine_chunks()


def episodes_of(layout: Layout, cell: RecordedCell) -> pa.Table | None:
    """Read the episodes of a cell; None where it is not computed.

    Raises:
        StoreError: its rows are damaged, or those of another cell.
    """
    path = table_of(layout, cell)
    if path is None:
        return None
    return read_rows(path, cell, [field.name for field in EPISODE]).table


def steps_of(layout: Layout, cell: RecordedCell) -> pa.Table | None:
    """Read the decisions of a cell, as `episodes_of` reads its episodes."""
    if episodes_of(layout, cell) is None:  # which refuses the rows of another cell
        return None
    return read_steps(rows_of(layout, cell))


def all_steps(
    layout: Layout, cells: Sequence[RecordedCell], columns: Iterable[str] | None
) -> pa.Table:
    """Read the steps of cells; a warning says of how many episodes they are not here."""
    asked = None
    read = None
    if columns is not None:
        asked = list(_values(columns))
        read = [*asked, "episode"]
    rows = stacked(layout, cells, steps_of, STEPS, read)
    whole = stacked(layout, cells, episodes_of, EPISODE, ["episode"])
    here = _count_of_episodes(rows)
    there = _count_of_episodes(whole)
    if here < there:
        told = (
            "published results leave out the others: wasp run SPEC --reuse none computes cells "
            "whole"
        )
        warnings.warn(f"{here} of {there} episodes have steps; {told}", stacklevel=3)
    if asked is None or "episode" in asked:
        return rows
    return rows.drop_columns("episode")


def _count_of_episodes(rows: pa.Table) -> int:
    count: int = rows.group_by(["key", "episode"]).aggregate([]).num_rows
    return count


def branches_of(layout: Layout, cell: RecordedCell) -> pa.Table | None:
    """Return the counterfactual branches of a cell, a row each; None where it has none.

    Raises:
        StoreError: the file holds those of another cell.
    """
    if cell.branches is None:
        return None
    path = layout.within(layout.artifact(BRANCHES, cell.branches) / BRANCHES_FILE)
    if not path.is_file():
        return None
    stored = read_branches(path)
    if stored.cell.identity != cell.identity:
        raise StoreError(f"{path} holds the branches of another cell than {cell.label}", AGAIN)
    cost = stored.cost
    reward = stored.reward
    count = len(stored.episode)
    worth = necessity(
        cost[ALONE], cost[ASSISTED], reward[ALONE], reward[ASSISTED], stored.cell.tau_R
    )
    columns = {
        "episode": stored.episode,
        "t": stored.t,
        "gate": stored.gate,
        "deviation": stored.deviation,
        "cost_assisted": cost[ASSISTED].sum(1),
        "cost_alone": cost[ALONE].sum(1),
        "reward_assisted": reward[ASSISTED].sum(1),
        "reward_alone": reward[ALONE].sum(1),
        "rho": worth.rho,
        "delta_c": worth.delta_c,
        "delta_r": worth.delta_r,
        "unnecessary": worth.unnecessary,
        "unnecessary_swapped": worth.swapped,
        "effective": worth.effective,
        "window": np.full(count, stored.cell.window),
        "tau_R": np.full(count, stored.cell.tau_R),
    }
    return pa.table(
        {field.name: pa.array(columns[field.name]).cast(field.type) for field in BRANCH}
    )


def trained_table(
    layout: Layout,
    cells: Iterable[str],
    parts: Sequence[tuple[str, str]] | None,
    wanted: Mapping[str, Any],
) -> pa.Table:
    """Return the trained artifacts, a row each, with the numbers of their summaries as columns.

    Args:
        layout: of the results folder.
        cells: keys of the cells whose upstream is meant.
        parts: kind and key of what a run trains; None: of no run.
        wanted: as `chosen` takes it.

    Raises:
        UnknownName: nothing has a value that is wanted.
    """
    # Imported here: what a report needs is not needed for rows.
    from wasp_cli.report.trained.artifacts import NOT_TRAINED, scalars, trained_artifacts

    # The artifacts that are meant: of cells, of a run, or else of the whole store.
    roots = [*((KIND, key) for key in cells), *(parts or ())]
    if not roots and parts is None:
        kinds = [kind for kind in stored_kinds(layout) if kind not in NOT_TRAINED]
        roots = [
            (kind, key)
            for kind in kinds
            for key in sorted(filter(is_key, stored_keys(layout, kind)))
        ]

    # Their names, then the numbers of their summaries.
    shown = chosen(trained_artifacts(layout, roots)[0], wanted)
    columns: dict[str, list[Any]] = {
        name: [getattr(part, name) for part in shown]
        for name in ("key", "kind", "task", "seed", "seconds")
    }
    columns["folder"] = [str(layout.artifact(part.kind, part.key)) for part in shown]
    numbers = [
        {f"{name}_" if name in columns else name: value for name, value in scalars(part.summary)}
        for part in shown
    ]
    for name in dict.fromkeys(name for each in numbers for name in each):
        columns[name] = [each.get(name) for each in numbers]
    return pa.table({name: _array(values) for name, values in columns.items()})


def _array(values: Sequence[Any]) -> pa.Array:
    try:
        return pa.array(values)
    except (pa.ArrowException, OverflowError):  # numbers and words, or an integer without end
        return pa.array([None if value is None else str(value) for value in values], pa.string())


def report_table(run: RunRecord, name: str) -> pa.Table:
    """Make one table of the report of a run."""
    from wasp_cli.cells.asked import asked_of
    from wasp_cli.report.render import data_columns
    from wasp_cli.report.summarize import report_run
    from wasp_cli.spec.paper import load_paper

    paper = load_paper() if name == "paper" else None
    report = report_run(asked_of(run), paper)
    known = {table.name: table for table in report.tables}
    if "table1" in known:
        known["main"] = known["table1"]
    if name not in known:
        raise UnknownName("table", name, known)
    return pa.table(data_columns(known[name]))
