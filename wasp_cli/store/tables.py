"""The two Parquet files of a cell: `episodes.parquet` has a row per episode, `_steps.pq` a row per
decision.

    thresholds = Thresholds(tau_c=0.3, tau_r=0.41)
    rows = [episode_metrics(trajectory, success_goals, safe_cost) for trajectory in trajectories]
    cell = CellIdentity("goal1", "wasp", "full", "noisy", 0.4, seed=0)
    path = write_cell(folder, cell, trajectories, rows, thresholds, decision_ms, episode_seeds)

    cell_file(folder)      the table of a cell in its folder; the functions below are given its path
    read_episodes(paths)   the episode columns of many cells, in the order of `paths`
    read_steps(path)       the steps of one cell: `episode`, then the fields of STEP
    read_times(path)       the decision times of its episodes;  read_version(path)   the table
    version it was written with same_rows(a, b)        whether two cells hold the same rows, timing
    aside

A report opens thousands of cells and reads no step, so that episodes lie in a small file of their
own. Both files name their cell in every row: `from read_parquet('store/evaluate/*/_steps.pq') where
method = 'wasp'` needs no other file. The steps have a name that readers of folders leave alone (an
underscore) and that `*.parquet` does not match, since one table of both would be neither:
`store/evaluate` is a dataset of episodes. Undefined numbers are null. Everything but the TIMING
columns is a function of the cell's key. In the rows of earlier versions ADDED is null, and RENAMED
has their names of columns.
"""

from __future__ import annotations

import filecmp
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wasp_cli.errors import StoreError
from wasp_cli.metrics.episode import EpisodeMetrics, Trajectory
from wasp_cli.store.parquet import opened_table, write_table

# names of the tables inside the artifact of a cell
EPISODES_FILE, STEPS_FILE = "episodes.parquet", "_steps.pq"

# grows with every change of SCHEMA or STEPS_SCHEMA; a file of a newer version is refused
VERSION = 5

VERSION_KEY, STEPS_KEY = b"wasp.cell", b"wasp.steps"
OLDEST = 3  # the first version that is read: rows and steps in files of their own


def _required(kind: pa.DataType, *names: str) -> list[pa.Field]:
    return [pa.field(name, kind, nullable=False) for name in names]


def _optional(kind: pa.DataType, *names: str) -> list[pa.Field]:
    return [pa.field(name, kind) for name in names]


STEP = pa.struct(
    [
        *_required(pa.int32(), "t"),
        *_required(pa.float32(), "reward"),
        *_required(pa.bool_(), "cost"),
        *_required(pa.int16(), "cost_env", "env_steps", "goals"),
        *_required(pa.list_(pa.float32()), "a_h", "a"),
        *_required(pa.float32(), "deviation"),
        *_required(pa.int8(), "gate"),
        *_optional(pa.float32(), "g_cost", "g_return", "delta_g", "signal"),
        *_optional(pa.float32(), "plan_cost", "plan_return", "alone_cost", "alone_return"),
        pa.field("safe", pa.list_(pa.int16())),
        pa.field("case2", pa.list_(pa.bool_())),
        pa.field("plan", pa.list_(pa.float32())),
    ]
)
"""A decision step; the meaning of the fields is that of `metrics.episode.Trajectory` and `Plans`.
`safe` and `case2` have an entry per iteration searched, `plan` the L residuals one after the other;
each is null where there was no search, or no plan."""
PLANNED = {
    "plan_cost": "cost",
    "plan_return": "reward",
    "alone_cost": "alone_cost",
    "alone_return": "alone_reward",
    "safe": "safe",
    "case2": "case2",
    "plan": "residuals",
}
"""Fields of STEP that come from `Plans`, with their names there."""

IDENTITY = (
    *_required(pa.string(), "task", "method", "variant", "operator"),
    pa.field("value", pa.float64()),
    pa.field("seed", pa.int64(), nullable=False),
    pa.field("episode", pa.int32(), nullable=False),
    pa.field("episode_seed", pa.int64(), nullable=False),
)
METRICS = (
    *_required(pa.int32(), "decisions", "env_steps", "intervened", "planned"),
    pa.field("handovers", pa.int32()),
    *_required(pa.float64(), "return"),
    *_required(pa.bool_(), "success", "safe_success"),
    *_required(pa.int32(), "goals", "cost"),
    *_required(pa.float64(), "viol", "viol_env"),
    *_required(pa.bool_(), "violated"),
    *_required(pa.float64(), "int_rate", "int_rate_05", "int_rate_10", "mag"),
    *_optional(pa.float64(), "mag_int", "int_eff", "mag_eff", "jump", "smoothness"),
    *_required(pa.float64(), "safety_gate", "task_gate"),
    pa.field("case2", pa.float64()),
)
# columns of METRICS, and the first version that has them
ADDED, ADDED_IN = ("handovers", "int_eff", "mag_eff", "jump"), 4
RENAMED, RENAMED_IN = {"operator": "variant", "variant": "assistant_variant"}, 5
"""Columns of IDENTITY with their names before, and the first version that has today's."""
THRESHOLDS = tuple(_optional(pa.float64(), "tau_c", "tau_r", "tau_q"))
TIMES = tuple(_optional(pa.float32(), "decision_p50_ms", "decision_p95_ms"))
STEP_TIME = pa.field("decision_ms", pa.float32(), nullable=False)

# of the episodes
SCHEMA = pa.schema([*IDENTITY, *METRICS, *THRESHOLDS, *TIMES], {VERSION_KEY: str(VERSION).encode()})
STEPS_SCHEMA = pa.schema([*IDENTITY, *STEP, STEP_TIME], {STEPS_KEY: str(VERSION).encode()})

# columns that differ between two computations of one cell
TIMING = (*(field.name for field in TIMES), STEP_TIME.name)


@dataclass(frozen=True)
class CellIdentity:
    """What the rows of a cell have in common, named by what was computed (severity names belong
    to a spec).
    """

    task: str
    method: str
    variant: str  # of the method: `full`, or an ablation
    operator: str
    value: float | None  # severity value of the operator; None for the unimpaired one
    seed: int


@dataclass(frozen=True)
class Thresholds:
    """The thresholds in force in a cell; None where the method has no such threshold."""

    tau_c: float | None = None
    tau_r: float | None = None
    tau_q: float | None = None


class Rows(NamedTuple):
    episodes: pa.Table  # of SCHEMA
    steps: pa.Table  # of STEPS_SCHEMA


def write_cell(
    folder: Path,
    identity: CellIdentity,
    trajectories: Sequence[Trajectory],
    metrics: Sequence[EpisodeMetrics],
    thresholds: Thresholds,
    decision_ms: Sequence[NDArray[np.floating]],
    episode_seeds: Sequence[int],
    earlier: Rows | None = None,
) -> Path:
    """Write the tables of a cell; returns the path of its episodes. Each file appears complete or
    not at all, the episodes last.

    The same input gives the same bytes.

    Args:
        folder: where the files are to be.
        identity: what all rows share.
        trajectories: E episodes.
        metrics: their rows, from `metrics.episode.episode_metrics`.
        thresholds: in force for all rows.
        decision_ms: per episode [T], wall time of each decision in milliseconds.
        episode_seeds: the seed of each episode's world; operator and method have streams of their
            own.
        earlier: rows of the cell that come before these (`first_rows`).
    """
    first = 0 if earlier is None else len(earlier.episodes)
    new = cell_tables(
        identity, trajectories, metrics, thresholds, decision_ms, episode_seeds, first
    )
    pieces = [new] if earlier is None else [earlier, new]
    episodes, steps = (
        pa.concat_tables(tables).combine_chunks() for tables in zip(*pieces, strict=True)
    )
    write_table(steps, folder / STEPS_FILE)
    write_episodes(episodes, folder / EPISODES_FILE)
    return folder / EPISODES_FILE


def write_episodes(episodes: pa.Table, path: Path) -> None:
    # Reports open thousands of these: pages without dictionaries that unpack fast take half the
    # time and no more space.
    write_table(episodes, path, compression="snappy", use_dictionary=False)


def cell_tables(
    identity: CellIdentity,
    trajectories: Sequence[Trajectory],
    metrics: Sequence[EpisodeMetrics],
    thresholds: Thresholds,
    decision_ms: Sequence[NDArray[np.floating]],
    episode_seeds: Sequence[int],
    first: int = 0,
) -> Rows:
    """Build the tables of a cell in memory, or of its episodes from `first` on; see
    `write_cell`.
    """
    episodes = len(trajectories)
    if not episodes == len(metrics) == len(decision_ms) == len(episode_seeds):
        raise ValueError(
            f"{episodes} trajectories, {len(metrics)} rows, {len(decision_ms)} timings, "
            f"{len(episode_seeds)} seeds"
        )
    columns: dict[str, Any] = {
        name: [value] * episodes for name, value in (asdict(identity) | asdict(thresholds)).items()
    }
    columns |= {
        "episode": list(range(first, first + episodes)),
        "episode_seed": [int(seed) for seed in episode_seeds],
    }
    for field in METRICS:
        attribute = "return_" if field.name == "return" else field.name
        columns[field.name] = [getattr(row, attribute) for row in metrics]
    for name, share in (("decision_p50_ms", 50), ("decision_p95_ms", 95)):
        columns[name] = [
            float(np.percentile(times, share)) if len(times) else None for times in decision_ms
        ]
    table = pa.table([pa.array(columns[field.name], field.type) for field in SCHEMA], schema=SCHEMA)
    episode = np.repeat(np.arange(episodes), [trajectory.steps for trajectory in trajectories])
    names = [table[field.name].take(episode) for field in IDENTITY]
    times = pa.array(
        np.concatenate([np.asarray(times, np.float32) for times in decision_ms]), STEP_TIME.type
    )
    return Rows(table, pa.table([*names, *_steps(trajectories), times], schema=STEPS_SCHEMA))


def _steps(trajectories: Sequence[Trajectory]) -> list[pa.Array]:
    """The columns of STEP over the steps of all episodes."""

    def flat(name: str) -> NDArray[Any]:
        return np.concatenate(
            [np.asarray(getattr(trajectory, name)) for trajectory in trajectories]
        )

    lengths = [trajectory.steps for trajectory in trajectories]
    columns: dict[str, pa.Array] = {
        "t": pa.array(np.concatenate([np.arange(n) for n in lengths]), pa.int32())
    }
    planned = _planned(trajectories)
    for field in list(STEP)[1:]:
        if field.name in PLANNED:
            columns[field.name] = (
                pa.nulls(sum(lengths), field.type)
                if planned is None
                else _array_of(planned[field.name], field.type)
            )
            continue
        columns[field.name] = _array_of(flat(field.name), field.type)
    return list(columns.values())


def _planned(trajectories: Sequence[Trajectory]) -> dict[str, NDArray[Any]] | None:
    """The fields of PLANNED over all steps, masked where nothing was planned or searched; None
    of a method that does not plan.
    """
    plans = [trajectory.plans for trajectory in trajectories if trajectory.plans is not None]
    if len(plans) != len(trajectories):
        return None
    columns = {
        name: np.concatenate([np.asarray(getattr(each, source)) for each in plans])
        for name, source in PLANNED.items()
    }
    columns["plan"] = columns["plan"].reshape(len(columns["plan"]), -1)
    lacks = dict.fromkeys(columns, np.isnan(columns["plan"]).any(1)) | dict.fromkeys(
        ("safe", "case2"), columns["safe"][:, -1] < 0
    )
    return {
        name: np.ma.masked_array(
            values, np.broadcast_to(lacks[name].reshape(-1, *[1] * (values.ndim - 1)), values.shape)
        )
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


def cell_file(folder: Path) -> Path:
    """Return where the rows of a cell are in the folder of its artifact."""
    return folder / EPISODES_FILE


def read_episodes(paths: Iterable[Path]) -> pa.Table:
    """Read the episode columns of many cells, one below the other in the order of `paths`."""
    schema = SCHEMA.remove_metadata()
    tables = [_read(path, SCHEMA.names).cast(schema) for path in paths]
    return pa.concat_tables(tables).combine_chunks() if tables else schema.empty_table()


def first_rows(folder: Path, batch: int) -> Rows:
    """Read the rows of a cell of this version, to write them again before others: as many as
    whole batches of `batch` episodes have.
    """
    episodes = _read(folder / EPISODES_FILE, SCHEMA.names).cast(SCHEMA)
    whole = len(episodes) // batch * batch
    steps = _read_steps(folder / EPISODES_FILE, STEPS_SCHEMA.names).cast(STEPS_SCHEMA)
    return Rows(episodes.slice(0, whole), steps.filter(pc.less(steps["episode"], whole)))


def read_steps(path: Path) -> pa.Table:
    """Read the steps of a cell: `episode`, then the fields of STEP."""
    names = ["episode", *(field.name for field in STEP)]
    table = _read_steps(path, names)
    return pa.table([table[name] for name in names], names=names)


def read_times(path: Path) -> list[NDArray[np.float64]]:
    """Read [T] per episode: wall time of each decision in milliseconds, divided by the episodes
    that were decided side by side.
    """
    table = _read_steps(path, ("episode", "decision_ms"))
    episode, times = np.asarray(table["episode"]), np.asarray(table["decision_ms"], np.float64)
    return [times[episode == number] for number in _read(path, ("episode",))["episode"].to_pylist()]


def read_version(path: Path) -> int:
    """Read the table version that a cell was written with: what later versions added is null in
    its rows.
    """
    with opened_table(path, VERSION_KEY, VERSION, "the table of a cell") as file:
        return int(file.schema_arrow.metadata[VERSION_KEY])


def same_rows(a: Path, b: Path) -> bool:
    """Return whether two cells hold the same rows in the columns that both versions have, when
    the TIMING columns are left out.
    """
    files = _files(a), _files(b)
    # Copies are the common case, and comparing bytes is cheaper than comparing rows.
    if len(files[0]) == len(files[1]) and all(
        filecmp.cmp(*pair, shallow=False) for pair in zip(*files, strict=True)
    ):
        return True
    apart = {*(field.name for field in TIMES), *lacking(min(read_version(path) for path in (a, b)))}
    first, second = (read_episodes([path]).drop_columns(list(apart)) for path in (a, b))
    return bool(first.equals(second) and read_steps(a).equals(read_steps(b)))


def _read(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return some columns of a cell file, after its version was checked."""
    with opened_table(path, VERSION_KEY, VERSION, "the table of a cell") as file:
        return columns_of(file, columns, int(file.schema_arrow.metadata[VERSION_KEY]))


def columns_of(file: pq.ParquetFile, columns: Sequence[str], version: int) -> pa.Table:
    """Read columns by today's names from a file of a version of the episodes or steps; what it
    lacks is undefined.
    """
    former = RENAMED if version < RENAMED_IN else {}
    # a cell is too small for threads
    table = file.read(columns=[former.get(name, name) for name in columns], use_threads=False)
    now = {then: name for name, then in former.items()}
    return with_nulls(
        table.rename_columns([now.get(name, name) for name in table.column_names]),
        columns,
        lacking(version),
    )


def lacking(version: int) -> tuple[str, ...]:
    """Return which columns of the episodes a version does not have."""
    return ADDED if version < ADDED_IN else ()


def with_nulls(table: pa.Table, columns: Sequence[str], absent: Sequence[str]) -> pa.Table:
    """Return the table with the columns `absent`, undefined, at their places among `columns`."""
    for place, name in enumerate(columns):
        if name in absent:
            table = table.add_column(
                min(place, table.num_columns),
                SCHEMA.field(name),
                pa.nulls(table.num_rows, SCHEMA.field(name).type),
            )
    return table


def _read_steps(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return some columns of the steps that lie beside the episodes at `path`."""
    with opened_table(_steps_file(path), STEPS_KEY, VERSION, "the steps of a cell") as file:
        table = columns_of(file, columns, int(file.schema_arrow.metadata[STEPS_KEY]))
        for name in table.column_names:
            # How many values a page has is the one number of Parquet without a checksum: where it
            # is wrong, the last lists are cut off.
            lengths = (
                pc.unique(pc.list_value_length(table[name])).drop_null()
                if pa.types.is_list(table[name].type)
                else ()
            )
            if len(lengths) > 1:
                raise ValueError(f"the lists of '{name}' do not have one length")
        return table


def _files(path: Path) -> list[Path]:
    return [path, _steps_file(path)]


def _steps_file(path: Path) -> Path:
    """Return where the steps of the cell at `path` lie. Who reads a cell has seen that `path`
    is a plain file; nobody has of this one.
    """
    beside = path.with_name(STEPS_FILE)
    if not os.path.lexists(beside):
        raise StoreError(
            f"{beside} does not exist",
            "it belongs to the cell: copy both files, or run the spec again",
        )
    if beside.is_symlink() or not beside.is_file():
        raise StoreError(f"{beside} is no plain file")
    return beside
