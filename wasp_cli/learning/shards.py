"""Recorded episodes, with images or with vectors: compressed Parquet shards on disk, flat arrays in
memory.

Rows are by arrival: row t holds o_t and what came with it (a_{t-1}, r_t, c_t), so an episode of T
decisions has T + 1 rows and its first row is marked `first` with zero action, reward and cost. The
names of the cost sources are in the metadata of each shard. A shard has a column `pixels`, or where
the task shows no image a column `state`.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wasp_cli.errors import ArtifactError
from wasp_cli.tasks.base import CAMERA_SIZE

PIXELS = (6, CAMERA_SIZE, CAMERA_SIZE)
_BYTES = int(np.prod(PIXELS))
# key of the schema metadata that holds the names of the columns of `sources`, as JSON
_SOURCES = b"wasp.cost_sources"
HELD_OUT = 0.1  # share of the episodes of a dataset that no gradient sees


def _schema(recording: Recording, sources: Sequence[str]) -> pa.Schema:
    action = recording.action.shape[1]
    privileged = recording.privileged.shape[1]
    seen = ("pixels", pa.binary(_BYTES))
    if recording.reads == "state":
        seen = ("state", pa.list_(pa.float32(), recording.state.shape[1]))
    return pa.schema(
        [
            seen,
            ("action", pa.list_(pa.float32(), action)),
            ("reward", pa.float32()),
            ("cost", pa.float32()),
            ("cost_env", pa.float32()),
            ("sources", pa.list_(pa.int16())),
            ("goals", pa.int16()),
            ("terminal", pa.float32()),
            ("first", pa.float32()),
            ("privileged", pa.list_(pa.float32(), privileged)),
            ("episode", pa.int32()),
            ("behaviour", pa.string()),
        ],
        metadata={_SOURCES: json.dumps(list(sources)).encode()},
    )


class Recording(NamedTuple):
    """N rows, episodes one after the other."""

    pixels: NDArray[np.uint8]  # [N, 6, 64, 64]; empty where the task shows no image
    action: NDArray[np.float32]  # [N, A]
    reward: NDArray[np.float32]
    cost: NDArray[np.float32]  # [N] in {0, 1}: the decision step cost
    cost_env: NDArray[np.float32]  # [N] env steps of it that cost
    sources: NDArray[np.int16]  # [N, S] env steps of it in which each cost source cost
    goals: NDArray[np.int16]  # [N] goals reached in the decision step
    terminal: NDArray[np.float32]
    first: NDArray[np.float32]
    privileged: NDArray[np.float32]  # [N, P]
    episode: NDArray[np.int32]
    behaviour: NDArray[Any]  # [N] str
    # [N, S] what assistants see where the task shows no image; else empty
    state: NDArray[np.float32] = np.zeros(0, np.float32)

    @property
    def reads(self) -> Literal["pixels", "state"]:
        """Return which column holds what assistants see."""
        return "state" if len(self.state) else "pixels"

    @property
    def seen(self) -> NDArray[Any]:
        """Return what assistants see: images [N, 6, 64, 64], or vectors [N, S]."""
        return self.state if self.reads == "state" else self.pixels

    def window_starts(self, length: int) -> NDArray[np.int64]:
        """Return the rows [K] from which `length` rows follow within one episode."""
        starts = np.arange(len(self.first) - length + 1)
        whole: NDArray[np.int64] = starts[self.episode[starts] == self.episode[starts + length - 1]]
        return whole

    def held_out(self, share: float) -> NDArray[np.bool_]:
        """Return the mask [N] of the episodes that no training sees: at a share of 0.1 those
        numbered 9, 19, 29, ...

        By number and not by place, so that an episode stays on its side when others are appended.
        Where there are too few episodes for that, it is the last one.
        """
        period = held_out_period(share)
        chosen: NDArray[np.bool_] = self.episode % period == period - 1
        return chosen if chosen.any() else self.episode == self.episode.max()

    def rows(self, mask: NDArray[np.bool_]) -> Recording:
        """Select the rows of a mask [N] (whole episodes). Columns that were not read stay empty."""
        fields: dict[str, Any] = {
            name: value[mask] if len(value) else value for name, value in self._asdict().items()
        }
        return Recording(**fields)


def held_out_period(share: float) -> int:
    """Return every how many episodes one is held out; see `Recording.held_out`."""
    return max(1, round(1 / share))


def write_shard(path: Path, recording: Recording, sources: Sequence[str]) -> None:
    """Write whole episodes to one file; `sources` names the columns of `recording.sources`."""
    arrays = [
        _lists(recording.state) if recording.reads == "state" else _images(recording.pixels),
        _lists(recording.action),
        pa.array(recording.reward),
        pa.array(recording.cost),
        pa.array(recording.cost_env),
        _counts(recording.sources),
        pa.array(recording.goals),
        pa.array(recording.terminal),
        pa.array(recording.first),
        _lists(recording.privileged),
        pa.array(recording.episode),
        pa.array(recording.behaviour.tolist(), pa.string()),
    ]
    schema = _schema(recording, sources)
    pq.write_table(
        pa.Table.from_arrays(arrays, schema=schema),
        path,
        compression="zstd",
        compression_level=3,
        use_dictionary=["behaviour"],
    )


def shard_files(folder: Path) -> list[Path]:
    """List the files of a dataset artifact, in order."""
    found = sorted(folder.glob("shard-*.parquet"))
    if not found:
        raise ArtifactError(f"no shards in {folder}", "remove the artifact's folder and run again")
    return found


def read_shards(
    folder: Path, columns: Sequence[str] | None = None, mask: NDArray[np.bool_] | None = None
) -> Recording:
    """Read all rows of a dataset artifact, or those of a mask [N] (whole episodes), in order.
    Columns that are not asked for are empty.

    Shard after shard into place, so that the images are in memory once (a shard's twice).
    """
    files = shard_files(folder)
    try:
        counts = [pq.read_metadata(file).num_rows for file in files]
        ends = np.cumsum(counts)
        chosen = np.ones(ends[-1], bool) if mask is None else mask
        found: dict[str, NDArray[Any]] = {}
        written = 0
        for file, here in zip(files, np.split(chosen, ends[:-1]), strict=True):
            if not here.any():
                continue
            table = pq.read_table(file, columns=list(columns) if columns else None)
            for name in table.column_names:
                part = _to_numpy(table.column(name))[here]
                whole = found.setdefault(
                    name, np.empty((int(chosen.sum()), *part.shape[1:]), part.dtype)
                )
                whole[written : written + len(part)] = part
            written += int(here.sum())
    except (OSError, pa.ArrowInvalid) as error:
        raise ArtifactError(
            f"cannot read {folder}: {error}", "remove the artifact's folder and run again"
        ) from error
    return Recording(**{name: found.get(name, np.zeros(0)) for name in Recording._fields})


def count_rows(path: Path) -> int:
    """Count the rows of a shard."""
    return int(pq.read_metadata(path).num_rows)


def hand_over(path: Path, target: Path) -> None:
    """Give a shard to another folder and keep it: as a second name of the same file where that
    is possible.
    """
    try:
        os.link(path, target)
    except OSError:  # another file system, or one without links
        shutil.copy2(path, target)


def cost_sources(folder: Path) -> tuple[str, ...]:
    """Read the names of the columns of `sources` of a dataset artifact."""
    return tuple(json.loads(pq.read_schema(shard_files(folder)[0]).metadata[_SOURCES]))


def _images(values: NDArray[np.uint8]) -> pa.Array:
    images = np.ascontiguousarray(values)
    return pa.FixedSizeBinaryArray.from_buffers(
        pa.binary(_BYTES), len(images), [None, pa.py_buffer(images)]
    )


def _counts(values: NDArray[np.int16]) -> pa.Array:
    # Not of a fixed size: a task may have no cost source, and Parquet cannot hold lists of the
    # fixed size 0.
    ends = pa.array(np.arange(len(values) + 1, dtype=np.int32) * values.shape[1])
    return pa.ListArray.from_arrays(ends, pa.array(np.ascontiguousarray(values, np.int16).ravel()))


def _lists(values: NDArray[np.float32]) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values, np.float32).ravel())
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _to_numpy(column: pa.ChunkedArray) -> NDArray[Any]:
    parts = []
    for chunk in column.chunks:
        kind = chunk.type
        if pa.types.is_fixed_size_binary(kind):
            data = np.frombuffer(chunk.buffers()[1], np.uint8).reshape(-1, *PIXELS)
            parts.append(data[chunk.offset : chunk.offset + len(chunk)])
        elif pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind):
            parts.append(chunk.flatten().to_numpy(zero_copy_only=False).reshape(len(chunk), -1))
        else:
            parts.append(chunk.to_numpy(zero_copy_only=False))
    return np.concatenate(parts)
