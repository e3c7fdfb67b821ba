"""The counterfactual branches of one cell: a Parquet file with two rows per branched decision.

    rows = [BranchRow(episode=0, t=12, branch="asst", costs=..., cost_env=..., rewards=...,
    deviation=0.8, gate=1), ...] write_branches(path, BranchedCell(identity, window=15, stride=1,
    tau_R=0.06, episodes=10), rows)

    read_branches(path)   what the rows have in common, and the pairs of rows side by side

The rows are sorted, the same input gives the same bytes, and a cell without interventions has a
file without rows. Letters: N branched decisions, W decision steps of a branch at most, w <= W of
one that ended early.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.store.parquet import damaged, opened_table, write_table
from wasp_cli.store.tables import IDENTITY, RENAMED, CellIdentity

BRANCHES_FILE = "branches.parquet"  # name of the table inside the artifact of a cell's branches
VERSION = 2  # grows with every change of SCHEMA; a file of a newer version is refused
RENAMED_IN = 2  # the first version with today's names of columns (`tables.RENAMED`)
VERSION_KEY, CELL_KEY = b"wasp.branches", b"wasp.branched_cell"

ROW = (
    pa.field("t", pa.int32(), nullable=False),
    pa.field("branch", pa.string(), nullable=False),
    pa.field("steps", pa.int16(), nullable=False),
    pa.field("costs", pa.list_(pa.bool_()), nullable=False),
    pa.field("cost_env", pa.list_(pa.int16()), nullable=False),
    pa.field("rewards", pa.list_(pa.float32()), nullable=False),
    pa.field("deviation", pa.float32(), nullable=False),
    pa.field("gate", pa.int8(), nullable=False),
    pa.field("tau_R", pa.float64(), nullable=False),
    pa.field("window", pa.int16(), nullable=False),
)
"""A branch: the decision at which it begins, its decision steps, c_t, env steps with cost and
reward of each, and of the decision the norm of a - a_h and the gate (`metrics.episode`)."""
SCHEMA = pa.schema([*(field for field in IDENTITY if field.name != "episode_seed"), *ROW])


@dataclass(frozen=True)
class BranchedCell:
    """What the rows of a file have in common."""

    identity: CellIdentity
    window: int  # W
    stride: int  # every how many interventions one was branched
    tau_R: float
    episodes: int  # of the cell


class BranchRow(NamedTuple):
    """One branch; see ROW."""

    episode: int
    t: int
    branch: str
    costs: Sequence[bool] | NDArray[np.bool_]
    cost_env: Sequence[int] | NDArray[np.integer]
    rewards: Sequence[float] | NDArray[np.floating]
    deviation: float
    gate: int


@dataclass(frozen=True, eq=False)
class Branches:
    """The N pairs of branches of a cell, sorted by episode and decision. Steps after the end of
    an episode are 0.
    """

    cell: BranchedCell
    episode: NDArray[np.int64]  # [N]
    t: NDArray[np.int64]  # [N]
    cost: Mapping[str, NDArray[np.float64]]  # [N, W] by branch: c_t
    reward: Mapping[str, NDArray[np.float64]]  # [N, W] by branch
    deviation: NDArray[np.float64]  # [N]
    gate: NDArray[np.int64]  # [N]


def write_branches(path: Path, cell: BranchedCell, rows: Sequence[BranchRow]) -> None:
    """Write the branches of a cell. The file appears complete or not at all; the same input
    gives the same bytes, in any order of rows.
    """
    write_table(branches_table(cell, rows), path)


def branches_table(cell: BranchedCell, rows: Sequence[BranchRow]) -> pa.Table:
    rows = sorted(rows, key=lambda row: row[:3])
    common = asdict(cell.identity) | {"tau_R": cell.tau_R, "window": cell.window}
    columns: dict[str, Any] = {name: [value] * len(rows) for name, value in common.items()}
    columns |= {name: [getattr(row, name) for row in rows] for name in BranchRow._fields}
    columns["steps"] = [len(row.costs) for row in rows]
    marks = {VERSION_KEY: str(VERSION), CELL_KEY: json.dumps(asdict(cell), sort_keys=True)}
    return pa.table(
        [pa.array(columns[field.name], field.type) for field in SCHEMA],
        schema=SCHEMA.with_metadata(marks),
    )


def read_branches(path: Path) -> Branches:
    table, cell = _read(path)
    try:
        return _paired(cell, table)
    except (LookupError, TypeError, ValueError) as error:
        raise damaged(path, error) from error


def _paired(cell: BranchedCell, table: pa.Table) -> Branches:
    episode, t, gate = (np.asarray(table[name], np.int64) for name in ("episode", "t", "gate"))
    later = np.diff(episode[::2]) * (1 << 32) + np.diff(t[::2])  # both are 32 bits wide
    alternating = table["branch"].to_pylist() == [ASSISTED, ALONE] * (len(t) // 2)
    if not (
        alternating
        and (episode[::2] == episode[1::2]).all()
        and (t[::2] == t[1::2]).all()
        and (later > 0).all()
    ):
        raise ValueError("its rows are not sorted pairs of branches")
    costs, rewards = (_steps(table, name, cell.window) for name in ("costs", "rewards"))
    return Branches(
        cell,
        episode[::2],
        t[::2],
        {ASSISTED: costs[::2], ALONE: costs[1::2]},
        {ASSISTED: rewards[::2], ALONE: rewards[1::2]},
        np.asarray(table["deviation"], np.float64)[::2],
        gate[::2],
    )


def _steps(table: pa.Table, name: str, width: int) -> NDArray[np.float64]:
    """[rows, W], zero after the end of a branch."""
    nested = table[name].combine_chunks()
    lengths, steps = (
        np.asarray(nested.value_lengths().fill_null(0), np.int64),
        np.asarray(table["steps"], np.int64),
    )
    wrong = np.flatnonzero((lengths != steps) | (steps < 1) | (steps > width))
    if wrong.size:
        raise ValueError(
            f"a branch of {steps[wrong[0]]} steps has {lengths[wrong[0]]} {name}, in a "
            f"window of {width}"
        )
    flat = np.asarray(nested.flatten().cast(pa.float64()).fill_null(np.nan))
    if not np.isfinite(flat).all():
        raise ValueError(f"{name} are not finite")
    padded = np.zeros((len(steps), width))
    padded[np.arange(width) < steps[:, None]] = flat
    return padded


def _read(path: Path) -> tuple[pa.Table, BranchedCell]:
    """Return the rows of a file and what they have in common, after its version was checked."""
    with opened_table(path, VERSION_KEY, VERSION, "a table of counterfactual branches") as file:
        renamed = RENAMED if int(file.schema_arrow.metadata[VERSION_KEY]) < RENAMED_IN else {}
        now = {former: name for name, former in renamed.items()}
        table = file.read(
            columns=[renamed.get(name, name) for name in SCHEMA.names], use_threads=False
        )
        table = table.rename_columns([now.get(name, name) for name in table.column_names])
        # pyarrow leaves out, without a word, a column that the footer does not name
        if table.column_names != SCHEMA.names:
            raise ValueError(f"its columns are {', '.join(table.column_names)}")
        return table, _cell(file.schema_arrow.metadata[CELL_KEY], now)


def _cell(text: bytes, renamed: Mapping[str, str]) -> BranchedCell:
    values = json.loads(text)
    values["identity"] = {
        renamed.get(name, name): value for name, value in values["identity"].items()
    }
    cell = BranchedCell(**{**values, "identity": CellIdentity(**values["identity"])})
    numbers = (cell.window, cell.stride, cell.episodes)
    if not all(type(number) is int and number >= 1 for number in numbers) or not np.isfinite(
        cell.tau_R
    ):
        raise ValueError("its window, stride, number of episodes or tau_R is none")
    return cell
