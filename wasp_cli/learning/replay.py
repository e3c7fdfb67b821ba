"""Recorded episodes with images: compressed Parquet shards on disk, flat arrays in memory.

Rows are by arrival: row t holds o_t and what came with it (a_{t-1}, r_t, c_t), so an episode of T decisions has T + 1 rows and its
first row is marked `first` with zero action, reward and cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wasp_cli.errors import ArtifactError
from wasp_cli.tasks.base import CAMERA_SIZE

PIXELS = (6, CAMERA_SIZE, CAMERA_SIZE)
_BYTES = int(np.prod(PIXELS))
HELD_OUT = 0.1
"""Share of the episodes of a dataset that no gradient sees."""


def _schema(action: int, privileged: int) -> pa.Schema:
    return pa.schema(
        [
            ("pixels", pa.binary(_BYTES)),
            ("action", pa.list_(pa.float32(), action)),
            ("reward", pa.float32()),
            ("cost", pa.float32()),
            ("cost_env", pa.float32()),
            ("terminal", pa.float32()),
            ("first", pa.float32()),
            ("privileged", pa.list_(pa.float32(), privileged)),
            ("episode", pa.int32()),
            ("behaviour", pa.string()),
        ]
    )


class Replay(NamedTuple):
    """N rows, episodes one after the other."""

    pixels: NDArray[np.uint8]
    """[N, 6, 64, 64]"""
    action: NDArray[np.float32]
    """[N, A]"""
    reward: NDArray[np.float32]
    cost: NDArray[np.float32]
    """[N] in {0, 1}: the decision step cost"""
    cost_env: NDArray[np.float32]
    """[N] env steps of it that cost"""
    terminal: NDArray[np.float32]
    first: NDArray[np.float32]
    privileged: NDArray[np.float32]
    """[N, P]"""
    episode: NDArray[np.int32]
    behaviour: NDArray[Any]
    """[N] str"""

    def window_starts(self, length: int) -> NDArray[np.int64]:
        """Rows from which `length` rows follow within one episode."""
        starts = np.arange(len(self.first) - length + 1)
        whole: NDArray[np.int64] = starts[self.episode[starts] == self.episode[starts + length - 1]]
        return whole

    def held_out(self, share: float) -> NDArray[np.bool_]:
        """[N] rows of the last `share` of the episodes, which no training sees."""
        episodes = int(self.episode.max()) + 1
        return self.episode >= episodes - max(1, round(share * episodes))

    def rows(self, mask: NDArray[np.bool_]) -> Replay:
        """The rows of a mask (whole episodes)."""
        fields: dict[str, Any] = {name: value[mask] for name, value in self._asdict().items()}
        return Replay(**fields)


def write_shard(path: Path, replay: Replay) -> None:
    """Write whole episodes to one file."""
    images = np.ascontiguousarray(replay.pixels)
    arrays = [
        pa.FixedSizeBinaryArray.from_buffers(pa.binary(_BYTES), len(replay.first), [None, pa.py_buffer(images)]),
        _lists(replay.action), pa.array(replay.reward), pa.array(replay.cost), pa.array(replay.cost_env), pa.array(replay.terminal),
        pa.array(replay.first),
        _lists(replay.privileged), pa.array(replay.episode), pa.array(replay.behaviour.tolist(), pa.string()),
    ]  # fmt: skip
    schema = _schema(replay.action.shape[1], replay.privileged.shape[1])
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path, compression="zstd", compression_level=3, use_dictionary=["behaviour"])


def read_replay(folder: Path, columns: Sequence[str] | None = None) -> Replay:
    """All shards of a dataset artifact, in order. Columns that are not asked for are empty.

    Raises:
        ArtifactError: there is no shard, or one is damaged.
    """
    shards = sorted(folder.glob("shard-*.parquet"))
    if not shards:
        raise ArtifactError(f"no shards in {folder}", "remove the artifact's folder and run again")
    try:
        table = pa.concat_tables([pq.read_table(shard, columns=list(columns) if columns else None) for shard in shards]).combine_chunks()
    except (OSError, pa.ArrowInvalid) as error:
        raise ArtifactError(f"cannot read {folder}: {error}", "remove the artifact's folder and run again") from error
    empty = np.zeros(0)
    found = {name: _to_numpy(table.column(name)) for name in table.column_names}
    return Replay(**{name: found.get(name, empty) for name in Replay._fields})


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
        elif pa.types.is_fixed_size_list(kind):
            parts.append(chunk.flatten().to_numpy(zero_copy_only=False).reshape(len(chunk), -1))
        else:
            parts.append(chunk.to_numpy(zero_copy_only=False))
    return np.concatenate(parts)
