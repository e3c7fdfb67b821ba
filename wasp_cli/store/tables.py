"""The two Parquet files of a cell: `episodes.parquet` has a row per episode, `_steps.pq` a row per
decision.

    thresholds = Thresholds(tau_c=0.3, tau_r=0.41)
    rows = [episode_metrics(trajectory, success_goals, safe_cost) for trajectory in trajectories]
    cell = CellIdentity("goal1", "wasp", "full", "noisy", 0.4, seed=0)
    path = write_cell(folder, cell, trajectories, rows, thresholds, decision_ms, episode_seeds)

    cell_file(folder)     the table of a cell in its folder; the functions below are given its path
    read_episodes(paths)  the episode columns of many cells, in the order of `paths`
    read_steps(path)      the steps of one cell: `episode`, then the fields of STEP
    read_times(path)      the decision times of its episodes
    read_version(path)    the table version it was written with
    same_rows(a, b)       whether two cells hold the same rows, timing aside

A report opens thousands of cells and reads no step, so that episodes lie in a small file of their
own. Both files name their cell in every row: `from read_parquet('store/evaluate/*/_steps.pq') where
method = 'wasp'` needs no other file. The steps have a name that readers of folders leave alone (an
underscore) and that `*.parquet` does not match, since one table of both would be neither:
`store/evaluate` is a dataset of episodes. The columns are in `schema`, also those of former
versions.
"""

from __future__ import annotations

import filecmp
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wasp_cli.errors import StoreError
from wasp_cli.metrics.episode import EpisodeMetrics, Trajectory
from wasp_cli.store.parquet import opened_table, write_table
from wasp_cli.store.rows import Rows, cell_tables
from wasp_cli.store.schema import (
    ADDED,
    ADDED_IN,
    EPISODES_FILE,
    IDENTITY,
    METRICS,
    OLDEST,
    PLANNED,
    RENAMED,
    RENAMED_IN,
    SCHEMA,
    STEP,
    STEP_TIME,
    STEPS_FILE,
    STEPS_KEY,
    STEPS_SCHEMA,
    THRESHOLDS,
    TIMES,
    TIMING,
    VERSION,
    VERSION_KEY,
    CellIdentity,
    Thresholds,
    lacking,
)

__all__ = [
    "ADDED",
    "ADDED_IN",
    "EPISODES_FILE",
    "IDENTITY",
    "METRICS",
    "OLDEST",
    "PLANNED",
    "RENAMED",
    "RENAMED_IN",
    "SCHEMA",
    "STEP",
    "STEPS_FILE",
    "STEPS_KEY",
    "STEPS_SCHEMA",
    "STEP_TIME",
    "THRESHOLDS",
    "TIMES",
    "TIMING",
    "VERSION",
    "VERSION_KEY",
    "CellIdentity",
    "Rows",
    "Thresholds",
    "cell_file",
    "cell_tables",
    "columns_of",
    "first_rows",
    "lacking",
    "read_episodes",
    "read_steps",
    "read_times",
    "read_version",
    "same_rows",
    "with_nulls",
    "write_cell",
    "write_episodes",
]
"""Who writes or reads cells needs the names of `schema` and `rows` too."""


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
        decision_ms: per episode [T], wall time of each decision in ms.
        episode_seeds: the seed of each episode's world; operator and method have streams of their
            own.
        earlier: rows of the cell that come before these (`first_rows`).

    Raises:
        StoreError: a file cannot be written.
        ValueError: the sequences are not of the same number of episodes.
    """
    first = 0 if earlier is None else len(earlier.episodes)
    new = cell_tables(
        identity, trajectories, metrics, thresholds, decision_ms, episode_seeds, first
    )
    pieces = [new] if earlier is None else [earlier, new]
    steps = pa.concat_tables([piece.steps for piece in pieces])
    write_table(steps.combine_chunks(), folder / STEPS_FILE)
    episodes = pa.concat_tables([piece.episodes for piece in pieces])
    write_episodes(episodes.combine_chunks(), folder / EPISODES_FILE)
    return folder / EPISODES_FILE


def write_episodes(episodes: pa.Table, path: Path) -> None:
    """Write the episodes of a cell. Raises StoreError where the file cannot be written."""
    # Reports open thousands of these: pages without dictionaries that unpack fast take half the
    # time and no more space.
    write_table(episodes, path, compression="snappy", use_dictionary=False)


def cell_file(folder: Path) -> Path:
    """Return where the rows of a cell are in the folder of its artifact."""
    return folder / EPISODES_FILE


def read_episodes(paths: Iterable[Path]) -> pa.Table:
    """Read the episode columns of many cells, one below the other in the order of `paths`. Raises
    StoreError where a file is missing, damaged, or of a newer version.
    """
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
    """Read the steps of a cell: `episode`, then the fields of STEP. Raises StoreError as
    `read_episodes` does.
    """
    names = ["episode", *(field.name for field in STEP)]
    table = _read_steps(path, names)
    return pa.table([table[name] for name in names], names=names)


def read_times(path: Path) -> list[NDArray[np.float64]]:
    """Read [T] per episode: wall time of each decision in ms, divided by the episodes that were
    decided side by side.
    """
    table = _read_steps(path, ("episode", "decision_ms"))
    episode = np.asarray(table["episode"])
    times = np.asarray(table["decision_ms"], np.float64)
    numbers = _read(path, ("episode",))["episode"].to_pylist()
    return [times[episode == number] for number in numbers]


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
    steps_a = _steps_file(a)
    steps_b = _steps_file(b)
    # Copies are the common case, and comparing bytes is cheaper than comparing rows.
    if filecmp.cmp(a, b, shallow=False) and filecmp.cmp(steps_a, steps_b, shallow=False):
        return True
    older = min(read_version(a), read_version(b))
    ignored = [*(field.name for field in TIMES), *lacking(older)]
    episodes_a = read_episodes([a]).drop_columns(ignored)
    episodes_b = read_episodes([b]).drop_columns(ignored)
    return bool(episodes_a.equals(episodes_b) and read_steps(a).equals(read_steps(b)))


def _read(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return some columns of a cell file, after its version was checked."""
    with opened_table(path, VERSION_KEY, VERSION, "the table of a cell") as file:
        return columns_of(file, columns, int(file.schema_arrow.metadata[VERSION_KEY]))


def columns_of(file: pq.ParquetFile, columns: Sequence[str], version: int) -> pa.Table:
    """Read columns by today's names from a file of episodes or steps of a version; columns that it
    does not have are null.
    """
    # By the names of that version; a cell is too small for threads.
    former_names = RENAMED if version < RENAMED_IN else {}
    stored = [former_names.get(name, name) for name in columns]
    table = file.read(columns=stored, use_threads=False)
    # By today's names.
    names = {former: name for name, former in former_names.items()}
    table = table.rename_columns([names.get(name, name) for name in table.column_names])
    return with_nulls(table, columns, lacking(version))


def with_nulls(table: pa.Table, columns: Sequence[str], absent: Sequence[str]) -> pa.Table:
    """Return the table with the columns `absent`, all null, at their places among `columns`."""
    for place, name in enumerate(columns):
        if name in absent:
            field = SCHEMA.field(name)
            nulls = pa.nulls(table.num_rows, field.type)
            table = table.add_column(min(place, table.num_columns), field, nulls)
    return table


def _read_steps(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return some columns of the steps that lie beside the episodes at `path`."""
    with opened_table(_steps_file(path), STEPS_KEY, VERSION, "the steps of a cell") as file:
        table = columns_of(file, columns, int(file.schema_arrow.metadata[STEPS_KEY]))
        for name in table.column_names:
            if not pa.types.is_list(table[name].type):
                continue
            # How many values a page has is the one number of Parquet without a checksum: where it
            # is wrong, the last lists are cut off.
            lengths = pc.unique(pc.list_value_length(table[name])).drop_null()
            if len(lengths) > 1:
                raise ValueError(f"the lists of '{name}' do not have one length")
        return table


def _steps_file(path: Path) -> Path:
    """Where the steps of the cell at `path` lie. Callers have checked that `path` is a plain file;
    this file is checked here.
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
