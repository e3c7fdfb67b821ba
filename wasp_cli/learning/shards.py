"""Recorded episodes, with images or with vectors: compressed Parquet shards on disk, flat arrays in
memory.

Rows are by arrival: row t holds o_t and what came with it (a_{t-1}, r_t, c_t). So an episode of T
decisions has T + 1 rows, and its first row is marked `first`, with zero action, reward and cost.
The names of the cost sources are in the metadata of each shard. A shard has a column `pixels`, or
where the task shows no image a column `state`.
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

PIXELS = (6, CAMERA_SIZE, CAMERA_SIZE)  # shape of what two cameras see
_BYTES = int(np.prod(PIXELS))
_SOURCES = b"wasp.cost_sources"
"""Key of the schema metadata that holds the names of the columns of `sources`, as JSON."""
HELD_OUT = 0.1  # share of the episodes of a dataset that no gradient sees


def _schema(recording: Recording, sources: Sequence[str]) -> pa.Schema:
    """Return the columns of a shard, with the names of the cost sources as metadata."""
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
    action: NDArray[np.float32]  # [N, A] that led here
    reward: NDArray[np.float32]  # [N] of that decision
    cost: NDArray[np.float32]  # [N] in {0, 1}: that decision cost
    cost_env: NDArray[np.float32]  # [N] env steps of it that cost
    sources: NDArray[np.int16]  # [N, S] env steps of it in which each cost source cost
    goals: NDArray[np.int16]  # [N] goals reached in it
    terminal: NDArray[np.float32]  # [N] in {0, 1}: it ended the episode by the task's own rule
    first: NDArray[np.float32]  # [N] in {0, 1}: the episode begins here
    privileged: NDArray[np.float32]  # [N, P]
    episode: NDArray[np.int32]  # [N] number of the episode in the dataset
    behaviour: NDArray[Any]  # [N] str, who drove
    state: NDArray[np.float32] = np.zeros(0, np.float32)
    """[N, S] what assistants see where the task shows no image; otherwise empty."""

    @property
    def reads(self) -> Literal["pixels", "state"]:
        """Return which column holds what assistants see."""
        return "state" if len(self.state) else "pixels"

    @property
    def seen(self) -> NDArray[Any]:
        """Return what assistants see: images [N, 6, 64, 64], or vectors [N, S]."""
        return self.state if self.reads == "state" else self.pixels

    def window_starts(self, length: int) -> NDArray[np.int64]:
        """Return the rows [K] with which `length` rows of one episode begin."""
        starts = np.arange(len(self.first) - length + 1)
        same_episode = self.episode[starts] == self.episode[starts + length - 1]
        whole: NDArray[np.int64] = starts[same_episode]
        return whole

    def held_out(self, share: float) -> NDArray[np.bool_]:
        """Return the mask [N] of the episodes that no training sees: at a share of 0.1 those with
        the numbers 9, 19, 29, and so on.

        An episode is chosen by its number and not by its position, so that it stays held out when
        others are appended. Where there are too few episodes for that, the last one is held out.
        """
        period = held_out_period(share)
        mask: NDArray[np.bool_] = self.episode % period == period - 1
        if not mask.any():
            mask = self.episode == self.episode.max()
        return mask

    def rows(self, mask: NDArray[np.bool_]) -> Recording:
        """Select the rows of a mask [N], whole episodes. Columns that were not read stay empty."""
        columns: dict[str, Any] = {
            name: column[mask] if len(column) else column for name, column in self._asdict().items()
        }
        return Recording(**columns)


def held_out_period(share: float) -> int:
    """Return the number of episodes of which one is held out; see `Recording.held_out`."""
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
    """Return the files of a dataset artifact, in order.

    Raises:
        ArtifactError: there is none.
    """
    files = sorted(folder.glob("shard-*.parquet"))
    if not files:
        raise ArtifactError(f"no shards in {folder}", "remove the artifact's folder and run again")
    return files


def read_shards(
    folder: Path, columns: Sequence[str] | None = None, mask: NDArray[np.bool_] | None = None
) -> Recording:
    """Read the rows of a dataset artifact, in order.

    The shards are read one after the other into place, so that the images are in memory once, and
    those of one shard twice.

    Args:
        folder: of the artifact.
        columns: those to read; None is all. The others are empty.
        mask: [N] rows to read, of whole episodes; None is all.

    Raises:
        ArtifactError: there are no shards, or they cannot be read.
    """
    files = shard_files(folder)
    try:
        # -- which rows of each shard
        counts = [pq.read_metadata(file).num_rows for file in files]
        ends = np.cumsum(counts)
        chosen = np.ones(ends[-1], bool) if mask is None else mask
        total = int(chosen.sum())

        # -- shard after shard into place
        arrays: dict[str, NDArray[Any]] = {}
        begin = 0
        for file, here in zip(files, np.split(chosen, ends[:-1]), strict=True):
            if not here.any():
                continue
            table = pq.read_table(file, columns=list(columns) if columns else None)
            end = begin + int(here.sum())
            for name in table.column_names:
                part = _to_numpy(table.column(name))[here]
                if name not in arrays:
                    arrays[name] = np.empty((total, *part.shape[1:]), part.dtype)
                arrays[name][begin:end] = part
            begin = end
    except (OSError, pa.ArrowInvalid) as error:
        raise ArtifactError(
            f"cannot read {folder}: {error}", "remove the artifact's folder and run again"
        ) from error
    return Recording(**{name: arrays.get(name, np.zeros(0)) for name in Recording._fields})


def count_rows(path: Path) -> int:
    """Return the number of rows of a shard."""
    return int(pq.read_metadata(path).num_rows)


def hand_over(path: Path, target: Path) -> None:
    """Put a shard into another folder too: as a hard link, or as a copy where the file system does
    not allow one.
    """
    try:
        os.link(path, target)
    except OSError:
        shutil.copy2(path, target)


def cost_sources(folder: Path) -> tuple[str, ...]:
    """Return the names of the cost sources of a dataset artifact: of the columns of `sources`."""
    schema = pq.read_schema(shard_files(folder)[0])
    return tuple(json.loads(schema.metadata[_SOURCES]))


def _images(values: NDArray[np.uint8]) -> pa.Array:
    """Return images [N, ...] as binary values of a fixed size."""
    images = np.ascontiguousarray(values)
    return pa.FixedSizeBinaryArray.from_buffers(
        pa.binary(_BYTES), len(images), [None, pa.py_buffer(images)]
    )


def _counts(values: NDArray[np.int16]) -> pa.Array:
    """Return counts [N, S] as lists. Their size is not fixed, because a task may have no cost
    source, and Parquet cannot hold lists of the fixed size 0.
    """
    ends = pa.array(np.arange(len(values) + 1, dtype=np.int32) * values.shape[1])
    return pa.ListArray.from_arrays(ends, pa.array(np.ascontiguousarray(values, np.int16).ravel()))


def _lists(values: NDArray[np.float32]) -> pa.Array:
    """Return vectors [N, ...] as lists of a fixed size."""
    flat = pa.array(np.ascontiguousarray(values, np.float32).ravel())
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _to_numpy(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return a column as an array [N, ...]."""
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
