"""The one Parquet file of a cell: a row per episode, its steps nested inside.

    thresholds = Thresholds(tau_c=0.3, tau_r=0.41)
    rows = [episode_metrics(trajectory, success_goals, safe_cost) for trajectory in trajectories]
    cell = CellIdentity("goal1", "wasp", "full", "noisy", 0.4, seed=0)
    write_cell(path, cell, trajectories, rows, thresholds, decision_ms, episode_seeds)

    read_episodes(paths)   the episode columns of many cells, in the order of `paths`; steps are not read from disk
    read_steps(path)       the steps of one cell, flat: `episode`, then the fields of STEP
    read_times(path)       the decision times of its episodes;  read_version(path)   the table version it was written with
    same_rows(a, b)        whether two files hold the same rows, timing aside

A cell is one atomic file, and other tools read it, such as DuckDB:
`select episode, unnest(steps, recursive := true) from 'cell.parquet'`.
Undefined numbers are null. Everything but the TIMING columns is a function of the cell's key.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wasp_cli.metrics.episode import EpisodeMetrics, Trajectory
from wasp_cli.store.parquet import opened_table, write_table

CELL_FILE = "cell.parquet"
"""Name of the table inside the artifact of a cell."""

VERSION = 2
"""Grows with every change of SCHEMA; a file of a newer version is refused."""

VERSION_KEY = b"wasp.cell"

STEP = pa.struct(
    [
        pa.field("t", pa.int32(), nullable=False),
        pa.field("reward", pa.float32(), nullable=False),
        pa.field("cost", pa.bool_(), nullable=False),
        pa.field("cost_env", pa.int16(), nullable=False),
        pa.field("env_steps", pa.int16(), nullable=False),
        pa.field("goals", pa.int16(), nullable=False),
        pa.field("a_h", pa.list_(pa.float32()), nullable=False),
        pa.field("a", pa.list_(pa.float32()), nullable=False),
        pa.field("deviation", pa.float32(), nullable=False),
        pa.field("gate", pa.int8(), nullable=False),
        pa.field("g_cost", pa.float32()),
        pa.field("g_return", pa.float32()),
        pa.field("delta_g", pa.float32()),
        pa.field("signal", pa.float32()),
        pa.field("plan_cost", pa.float32()),
        pa.field("plan_return", pa.float32()),
        pa.field("alone_cost", pa.float32()),
        pa.field("alone_return", pa.float32()),
        pa.field("safe", pa.list_(pa.int16())),
        pa.field("case2", pa.list_(pa.bool_())),
        pa.field("plan", pa.list_(pa.float32())),
    ]
)
"""A decision step; the meaning of the fields is that of `metrics.episode.Trajectory` and `Plans`. `safe` and `case2` have an entry per
iteration, `plan` the L residuals one after the other; all that concerns a plan is null where nothing was planned."""
PLANNED = {
    "plan_cost": "cost", "plan_return": "reward", "alone_cost": "alone_cost", "alone_return": "alone_reward",
    "safe": "safe", "case2": "case2", "plan": "residuals",
}  # fmt: skip
"""Fields of STEP that come from `Plans`, with their names there."""

IDENTITY = (
    pa.field("task", pa.string(), nullable=False),
    pa.field("method", pa.string(), nullable=False),
    pa.field("assistant_variant", pa.string(), nullable=False),
    pa.field("variant", pa.string(), nullable=False),
    pa.field("value", pa.float64()),
    pa.field("seed", pa.int64(), nullable=False),
    pa.field("episode", pa.int32(), nullable=False),
    pa.field("episode_seed", pa.int64(), nullable=False),
)
METRICS = (
    pa.field("decisions", pa.int32(), nullable=False),
    pa.field("env_steps", pa.int32(), nullable=False),
    pa.field("intervened", pa.int32(), nullable=False),
    pa.field("planned", pa.int32(), nullable=False),
    pa.field("return", pa.float64(), nullable=False),
    pa.field("success", pa.bool_(), nullable=False),
    pa.field("safe_success", pa.bool_(), nullable=False),
    pa.field("goals", pa.int32(), nullable=False),
    pa.field("cost", pa.int32(), nullable=False),
    pa.field("viol", pa.float64(), nullable=False),
    pa.field("viol_env", pa.float64(), nullable=False),
    pa.field("violated", pa.bool_(), nullable=False),
    pa.field("int_rate", pa.float64(), nullable=False),
    pa.field("int_rate_05", pa.float64(), nullable=False),
    pa.field("int_rate_10", pa.float64(), nullable=False),
    pa.field("mag", pa.float64(), nullable=False),
    pa.field("mag_int", pa.float64()),
    pa.field("smoothness", pa.float64()),
    pa.field("safety_gate", pa.float64(), nullable=False),
    pa.field("task_gate", pa.float64(), nullable=False),
    pa.field("case2", pa.float64()),
)
THRESHOLDS = (pa.field("tau_c", pa.float64()), pa.field("tau_r", pa.float64()), pa.field("tau_q", pa.float64()))
TIMES = (
    pa.field("decision_p50_ms", pa.float32()),
    pa.field("decision_p95_ms", pa.float32()),
    pa.field("decision_ms", pa.list_(pa.float32()), nullable=False),
)

SCHEMA = pa.schema([*IDENTITY, *METRICS, *THRESHOLDS, *TIMES, pa.field("steps", pa.list_(STEP), nullable=False)]).with_metadata(
    {VERSION_KEY: str(VERSION).encode()}
)

TIMING = tuple(field.name for field in TIMES)
"""Columns that differ between two computations of one cell."""

EPISODE_COLUMNS = tuple(name for name in SCHEMA.names if name not in ("decision_ms", "steps"))


@dataclass(frozen=True)
class CellIdentity:
    """What the rows of a cell have in common, named by what was computed (severity names belong to a spec)."""

    task: str
    method: str
    assistant_variant: str
    variant: str
    """operator variant"""
    value: float | None
    """severity value of the operator; None for the unimpaired one"""
    seed: int


@dataclass(frozen=True)
class Thresholds:
    """The thresholds in force in a cell; None where the method has no such threshold."""

    tau_c: float | None = None
    tau_r: float | None = None
    tau_q: float | None = None


def write_cell(
    path: Path,
    identity: CellIdentity,
    trajectories: Sequence[Trajectory],
    metrics: Sequence[EpisodeMetrics],
    thresholds: Thresholds,
    decision_ms: Sequence[NDArray[np.floating]],
    episode_seeds: Sequence[int],
    earlier: pa.Table | None = None,
) -> None:
    """Write the table of a cell. The file appears complete or not at all; the same input gives the same bytes.

    Args:
        path: the file to be.
        identity: what all rows share.
        trajectories: E episodes.
        metrics: their rows, from `metrics.episode.episode_metrics`.
        thresholds: in force for all rows.
        decision_ms: per episode [T], wall time of each decision in milliseconds.
        episode_seeds: the seed of each episode's world; operator and method have streams of their own.
        earlier: rows of the cell that come before these (`first_rows`).

    Raises:
        StoreError: the file cannot be written.
    """
    first = 0 if earlier is None else len(earlier)
    table = cell_table(identity, trajectories, metrics, thresholds, decision_ms, episode_seeds, first)
    write_table(table if earlier is None else pa.concat_tables([earlier, table]).combine_chunks(), path)


def cell_table(
    identity: CellIdentity,
    trajectories: Sequence[Trajectory],
    metrics: Sequence[EpisodeMetrics],
    thresholds: Thresholds,
    decision_ms: Sequence[NDArray[np.floating]],
    episode_seeds: Sequence[int],
    first: int = 0,
) -> pa.Table:
    """Build the table of a cell in memory, or of its episodes from `first` on; see `write_cell`."""
    episodes = len(trajectories)
    if not episodes == len(metrics) == len(decision_ms) == len(episode_seeds):
        raise ValueError(f"{episodes} trajectories, {len(metrics)} rows, {len(decision_ms)} timings, {len(episode_seeds)} seeds")
    columns: dict[str, Any] = {name: [value] * episodes for name, value in (asdict(identity) | asdict(thresholds)).items()}
    columns |= {"episode": list(range(first, first + episodes)), "episode_seed": [int(seed) for seed in episode_seeds]}
    for field in METRICS:
        attribute = "return_" if field.name == "return" else field.name
        columns[field.name] = [getattr(row, attribute) for row in metrics]
    for name, share in (("decision_p50_ms", 50), ("decision_p95_ms", 95)):
        columns[name] = [float(np.percentile(times, share)) if len(times) else None for times in decision_ms]
    columns["decision_ms"] = [np.asarray(times, np.float32) for times in decision_ms]
    columns["steps"] = _steps(trajectories)
    return pa.table([_array(columns[field.name], field.type) for field in SCHEMA], schema=SCHEMA)


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    return values if isinstance(values, pa.Array) else pa.array(values, kind)


def _steps(trajectories: Sequence[Trajectory]) -> pa.Array:
    """list<STEP> with one entry per episode, built from flat columns."""

    def flat(name: str) -> NDArray[Any]:
        return np.concatenate([np.asarray(getattr(trajectory, name)) for trajectory in trajectories])

    lengths = [trajectory.steps for trajectory in trajectories]
    columns: dict[str, pa.Array] = {"t": pa.array(np.concatenate([np.arange(n) for n in lengths]), pa.int32())}
    planned = _planned(trajectories)
    for field in list(STEP)[1:]:
        if field.name in PLANNED:
            columns[field.name] = pa.nulls(sum(lengths), field.type) if planned is None else _array_of(planned[field.name], field.type)
            continue
        columns[field.name] = _array_of(flat(field.name), field.type)
    steps = pa.StructArray.from_arrays(list(columns.values()), fields=list(STEP))
    return pa.ListArray.from_arrays(np.cumsum([0, *lengths], dtype=np.int32), steps, type=pa.list_(STEP))


def _planned(trajectories: Sequence[Trajectory]) -> dict[str, NDArray[Any]] | None:
    """The fields of PLANNED over all steps, masked where nothing was planned; None of a method that does not plan."""
    plans = [trajectory.plans for trajectory in trajectories if trajectory.plans is not None]
    if len(plans) != len(trajectories):
        return None
    columns = {name: np.concatenate([np.asarray(getattr(each, source)) for each in plans]) for name, source in PLANNED.items()}
    nothing = columns["safe"][:, -1] < 0
    columns["plan"] = columns["plan"].reshape(len(nothing), -1)
    return {
        name: np.ma.masked_array(values, np.broadcast_to(nothing.reshape(-1, *[1] * (values.ndim - 1)), values.shape))
        for name, values in columns.items()
    }


def _array_of(values: NDArray[Any], kind: pa.DataType) -> pa.Array:
    """A column of steps [T] or of lists [T, K]; masked rows and NaN outside of lists are null."""
    mask = np.ma.getmaskarray(values)
    data = np.ma.getdata(values)
    if pa.types.is_list(kind):
        ends = np.arange(0, data.size + 1, data.shape[1], dtype=np.int32)
        inner = pa.array(data.ravel()).cast(kind.value_type)
        return pa.ListArray.from_arrays(ends, inner, type=kind, mask=pa.array(mask[:, 0]))
    if pa.types.is_float32(kind):
        return pa.array(data.astype(np.float32), kind, mask=mask | np.isnan(data))
    return pa.array(data, mask=mask).cast(kind)


def read_episodes(paths: Iterable[Path]) -> pa.Table:
    """Read the episode columns of many cells, one below the other in the order of `paths`.

    Raises:
        StoreError: a file is missing, damaged, of a newer version, or no cell table.
    """
    schema = pa.schema([SCHEMA.field(name) for name in EPISODE_COLUMNS])
    tables = [_read(path, EPISODE_COLUMNS).cast(schema) for path in paths]
    return pa.concat_tables(tables).combine_chunks() if tables else schema.empty_table()


def first_rows(path: Path, batch: int) -> pa.Table:
    """Read the rows of a cell of this version, to write them again before others: as many as whole batches of `batch` episodes have.

    Raises:
        StoreError: as `read_episodes`.
    """
    table = _read(path, SCHEMA.names).cast(SCHEMA)
    return table.slice(0, len(table) // batch * batch)


def read_steps(path: Path) -> pa.Table:
    """Read the steps of a cell, flat: `episode`, then the fields of STEP.

    Raises:
        StoreError: as `read_episodes`.
    """
    table = _read(path, ("episode", "steps"))
    nested = table["steps"].combine_chunks()
    lengths = np.asarray(nested.value_lengths())
    flat = nested.flatten()
    episode = pa.array(np.repeat(np.asarray(table["episode"]), lengths), pa.int32())
    known = {flat.type.field(i).name: i for i in range(flat.type.num_fields)}
    # An older file has fewer fields, or one of another type: what it does not say is null.
    fields = [
        flat.field(known[field.name]) if field.name in known and flat.type.field(known[field.name]).type == field.type
        else pa.nulls(len(flat), field.type)
        for field in STEP
    ]  # fmt: skip
    return pa.table([episode, *fields], names=["episode", *(field.name for field in STEP)])


def read_times(path: Path) -> list[NDArray[np.float64]]:
    """Read [T] per episode: wall time of each decision in milliseconds, divided by the episodes that were decided side by side.

    Raises:
        StoreError: as `read_episodes`.
    """
    return [np.asarray(times, np.float64) for times in _read(path, ("decision_ms",))["decision_ms"].to_pylist()]


def read_version(path: Path) -> int:
    """Read the table version that a cell was written with: what later versions added is null in its rows.

    Raises:
        StoreError: as `read_episodes`.
    """
    return int(_read(path, ("episode",)).schema.metadata[VERSION_KEY])


def same_rows(a: Path, b: Path) -> bool:
    """Return whether two cell files hold the same rows when the TIMING columns are left out."""
    names = tuple(name for name in SCHEMA.names if name not in TIMING)
    return bool(_read(a, names).equals(_read(b, names)))


def _read(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return some columns of a cell file, after its version was checked."""
    with opened_table(path, VERSION_KEY, VERSION, "the table of a cell") as file:
        return file.read(columns=list(columns), use_threads=False)  # a cell is too small for threads
