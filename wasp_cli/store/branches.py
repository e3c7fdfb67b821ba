"""The counterfactual branches of one cell: a Parquet file with two rows per branched decision.

    cell = BranchedCell(identity, window=15, stride=1, tau_R=0.06, episodes=10)
    row = BranchRow(episode=0, t=12, branch="asst", costs=..., cost_env=..., rewards=...,
                    deviation=0.8, gate=1)
    write_branches(path, cell, [row, ...])

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
from wasp_cli.store.schema import IDENTITY, RENAMED, CellIdentity

BRANCHES_FILE = "branches.parquet"  # name of the table inside the artifact of a cell's branches
VERSION = 2  # grows with every change of SCHEMA; a file of a newer version is refused
RENAMED_IN = 2  # the first version with today's names of columns (`schema.RENAMED`)
# where the version and the `BranchedCell`, as JSON, are in the metadata of a file
VERSION_KEY = b"wasp.branches"
CELL_KEY = b"wasp.branched_cell"

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
    """Return the branches of a cell as a table, sorted by episode, decision and branch."""
    rows = sorted(rows, key=_place)
    common = asdict(cell.identity) | {"tau_R": cell.tau_R, "window": cell.window}
    columns: dict[str, Any] = {name: [value] * len(rows) for name, value in common.items()}
    for name in BranchRow._fields:
        columns[name] = [getattr(row, name) for row in rows]
    columns["steps"] = [len(row.costs) for row in rows]
    marks = {VERSION_KEY: str(VERSION), CELL_KEY: json.dumps(asdict(cell), sort_keys=True)}
    return pa.table(
        [pa.array(columns[field.name], field.type) for field in SCHEMA],
        schema=SCHEMA.with_metadata(marks),
    )


def _place(row: BranchRow) -> tuple[int, int, str]:
    return row.episode, row.t, row.branch


def read_branches(path: Path) -> Branches:
    """Read the branches of a cell. Raises StoreError where the file is missing, damaged, or of a
    newer version.
    """
    table, cell = _read(path)
    try:
        return _paired(cell, table)
    except (LookupError, TypeError, ValueError) as error:
        raise damaged(path, error) from error


def _paired(cell: BranchedCell, table: pa.Table) -> Branches:
    """The rows side by side; ValueError where they are no sorted pairs of branches."""
    episode = np.asarray(table["episode"], np.int64)
    t = np.asarray(table["t"], np.int64)
    gate = np.asarray(table["gate"], np.int64)
    later = np.diff(episode[::2]) * (1 << 32) + np.diff(t[::2])  # both are 32 bits wide
    alternating = table["branch"].to_pylist() == [ASSISTED, ALONE] * (len(t) // 2)
    if not (
        alternating
        and (episode[::2] == episode[1::2]).all()
        and (t[::2] == t[1::2]).all()
        and (later > 0).all()
    ):
        raise ValueError("its rows are not sorted pairs of branches")
    costs = _steps(table, "costs", cell.window)
    rewards = _steps(table, "rewards", cell.window)
    return Branches(
        cell=cell,
        episode=episode[::2],
        t=t[::2],
        cost={ASSISTED: costs[::2], ALONE: costs[1::2]},
        reward={ASSISTED: rewards[::2], ALONE: rewards[1::2]},
        deviation=np.asarray(table["deviation"], np.float64)[::2],
        gate=gate[::2],
    )


def _steps(table: pa.Table, name: str, width: int) -> NDArray[np.float64]:
    """A column of lists as [rows, W], zero after the end of a branch."""
    nested = table[name].combine_chunks()
    lengths = np.asarray(nested.value_lengths().fill_null(0), np.int64)
    steps = np.asarray(table["steps"], np.int64)
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
    """The rows of a file and what they have in common, by today's names of columns."""
    with opened_table(path, VERSION_KEY, VERSION, "a table of counterfactual branches") as file:
        version = int(file.schema_arrow.metadata[VERSION_KEY])
        former_names = RENAMED if version < RENAMED_IN else {}
        stored = [former_names.get(name, name) for name in SCHEMA.names]
        table = file.read(columns=stored, use_threads=False)
        names = {former: name for name, former in former_names.items()}
        table = table.rename_columns([names.get(name, name) for name in table.column_names])
        # pyarrow leaves out, without a word, a column that the footer does not name
        if table.column_names != SCHEMA.names:
            raise ValueError(f"its columns are {', '.join(table.column_names)}")
        return table, _cell(file.schema_arrow.metadata[CELL_KEY], names)


def _cell(text: bytes, renamed: Mapping[str, str]) -> BranchedCell:
    """What the rows of a file have in common, from JSON; `renamed` has today's name of each former
    one.
    """
    values = json.loads(text)
    stored = values["identity"]
    identity = {renamed.get(name, name): value for name, value in stored.items()}
    values["identity"] = CellIdentity(**identity)
    cell = BranchedCell(**values)
    numbers = (cell.window, cell.stride, cell.episodes)
    are_counts = all(type(number) is int and number >= 1 for number in numbers)
    if not are_counts or not np.isfinite(cell.tau_R):
        raise ValueError("its window, stride, number of episodes or tau_R is none")
    return cell
