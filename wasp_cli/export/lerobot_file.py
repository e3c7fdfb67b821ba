"""A dataset of LeRobot in its format v3.0, which is described at
https://huggingface.co/docs/lerobot/lerobot-dataset-v3. LeRobot itself is not needed: it pins torch,
and brings codecs of video.

    meta/info.json                              features, number of frames, frames a second
    meta/stats.json                             statistics of every feature
    meta/tasks.parquet                          the task in words
    meta/episodes/chunk-000/file-000.parquet    a row per episode: where it lies, its statistics
    data/chunk-000/file-000.parquet             a row per frame, a row group per episode

A frame is a decision: what is seen before it, the action, and what that led to. Images are PNG.
What an assistant must not read is in `complementary_info`, from which LeRobot's policies take no
inputs.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

import wasp_cli
from wasp_cli.errors import ArtifactError
from wasp_cli.export.episode import PIXELS, Episode
from wasp_cli.export.folders import new_folder, require_place
from wasp_cli.export.lerobot_stats import Stats, as_json, image_stats, joined, number_stats
from wasp_cli.export.written import Source, Written, nothing_written
from wasp_cli.tasks.registry import TASKS

VERSION = "v3.0"  # of the format
MARK = "meta/info.json"
CHUNK = 1000  # files of a folder at most
FILE_MB = 100  # of a data file, about
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATH = f"data/{PLACE}"
EPISODES_PATH = f"meta/episodes/{PLACE}"
CAMERAS = ("observation.images.front", "observation.images.rear")
VECTOR = "observation.state"
INFO = "complementary_info"
INTERVENTION = f"{INFO}.is_intervention"
"""The flag of LeRobot's own recordings of interventions (`lerobot.rl`), a float there too."""
IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])


def require_lerobot_place(target: Path, *, force: bool) -> None:
    """See that a dataset of LeRobot can be written to a folder. Raises UsageError."""
    require_place(target, MARK, force=force)


def write_lerobot(source: Source, target: Path) -> Written:
    """Write the episodes of a source as a dataset.

    Args:
        source: of one task.
        target: the folder of the dataset.

    Returns:
        What was written. `LeRobotDataset("NAME", root=target)` loads it.

    Raises:
        UsageError, ArtifactError, StoreError: as reading the source does.
    """
    seconds = TASKS[source.task].env_seconds * source.action_repeat
    with new_folder(target) as staged:
        writer = _Writer(staged, source, 1.0 / seconds)
        for episode in source.episodes():
            writer.add(episode)
        if not writer.episodes:
            raise nothing_written(source)
        writer.finish()
    load = f"LeRobotDataset('wasp/{target.name}', root='{target}')"
    return Written(target, len(writer.episodes), writer.frames, load)


@dataclass
class _Writer:
    """A dataset that is being written."""

    folder: Path
    source: Source
    fps: float
    columns: dict[str, Column] = field(default_factory=dict)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    stats: dict[str, Stats] = field(default_factory=dict)
    frames: int = 0
    file: int = 0
    parquet: pq.ParquetWriter | None = None

    def add(self, episode: Episode) -> None:
        """Write an episode as a row group."""
        # -- the columns of its frames; the first episode says which there are
        columns = frame_columns(episode, cameras=self._cameras(episode))
        length = episode.decisions
        columns |= {
            "timestamp": Column((np.arange(length) / self.fps).astype(np.float32)),
            "frame_index": Column(np.arange(length)),
            "episode_index": Column(np.full(length, len(self.episodes))),
            "index": Column(np.arange(self.frames, self.frames + length)),
            "task_index": Column(np.zeros(length, np.int64)),
        }
        if not self.columns:
            self.columns = {name: column.empty() for name, column in columns.items()}
        self._require_alike(episode, columns)

        # -- the frames
        arrays = [column.arrow() for column in columns.values()]
        schema = _schema(columns)
        file = self._next_file()
        self._parquet(schema).write_table(pa.table(arrays, schema=schema))

        # -- what is said of the episode
        own = {name: column.stats() for name, column in columns.items()}
        known = {name: stats for name, stats in own.items() if stats is not None}
        for name, stats in known.items():
            self.stats[name] = joined(self.stats.get(name), stats)
        self.episodes.append(
            {
                "episode_index": len(self.episodes),
                "tasks": [self.task],
                "length": length,
                "data/chunk_index": file // CHUNK,
                "data/file_index": file % CHUNK,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + length,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **{f"wasp/{name}": value for name, value in episode.facts().items()},
                **{
                    f"stats/{feature}/{name}": values.tolist()
                    for feature, numbers in known.items()
                    for name, values in numbers.items()
                },
            }
        )
        self.frames += length

    @property
    def task(self) -> str:
        """The task in words: what a frame of LeRobot has for policies that read language."""
        return f"{TASKS[self.source.task].title}: high return at little cost"

    def finish(self) -> None:
        """Write what is said of the whole dataset."""
        if self.parquet is not None:
            self.parquet.close()
        _write_episodes(self.episodes, self.folder / EPISODES_PATH.format(**_FIRST))
        _write_tasks([self.task], self.folder / "meta" / "tasks.parquet")
        info = {
            "codebase_version": VERSION,
            "fps": int(self.fps) if float(self.fps).is_integer() else self.fps,
            "features": {name: column.feature() for name, column in self.columns.items()},
            "total_episodes": len(self.episodes),
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": CHUNK,
            "data_files_size_in_mb": FILE_MB,
            "video_files_size_in_mb": 200,
            "data_path": DATA_PATH,
            "video_path": None,
            "robot_type": self.source.task,
            "splits": {"train": f"0:{len(self.episodes)}"},
        }
        _write_json(self.folder / MARK, info)
        _write_json(self.folder / "meta" / "stats.json", as_json(self.stats))
        (self.folder / "README.md").write_text(self._card(), encoding="utf-8")

    def _cameras(self, episode: Episode) -> int:
        """How many cameras a task has: the image of a second one that is not there is black."""
        if episode.sees != PIXELS:
            return 0
        if self.columns:
            return sum(name in self.columns for name in CAMERAS)
        assert episode.seen is not None
        return 2 if episode.seen[:, 3:].any() else 1

    def _require_alike(self, episode: Episode, columns: Mapping[str, Column]) -> None:
        """Refuse an episode whose frames are of another form than those before."""
        first = {name: column.feature() for name, column in self.columns.items()}
        if {name: column.feature() for name, column in columns.items()} != first:
            raise ArtifactError(
                f"{episode.origin.label}, episode {episode.number}: what is seen, or an action, "
                "has another form than in the episodes before",
                "export it to a folder of its own",
            )

    def _next_file(self) -> int:
        """Go on to the next file where the present one is large enough; returns its number."""
        path = self.folder / DATA_PATH.format(**_file_place(self.file))
        if self.parquet is not None and path.stat().st_size >= FILE_MB * 2**20:
            self.parquet.close()
            self.parquet = None
            self.file += 1
        return self.file

    def _parquet(self, schema: pa.Schema) -> pq.ParquetWriter:
        if self.parquet is None:
            path = self.folder / DATA_PATH.format(**_file_place(self.file))
            path.parent.mkdir(parents=True, exist_ok=True)
            self.parquet = pq.ParquetWriter(path, schema, compression="snappy")
        return self.parquet

    def _card(self) -> str:
        """The page of the dataset on the hub."""
        labels = "\n".join(f"- `{label}`" for label in self.source.labels)
        return _CARD.format(
            title=TASKS[self.source.task].title,
            version=wasp_cli.__version__,
            episodes=len(self.episodes),
            frames=self.frames,
            fps=f"{self.fps:g}",
            labels=labels,
        )


_FIRST = {"chunk_index": 0, "file_index": 0}
_CARD = """\
---
license: apache-2.0
task_categories: [robotics]
tags: [LeRobot, shared-autonomy, safe-reinforcement-learning, wasp-cli]
configs:
- config_name: default
  data_files: data/*/*.parquet
---

Shared autonomy on {title}: {episodes} episodes, {frames} decisions, {fps} a second. Exported by
wasp {version} from

{labels}

`action` is what was executed, `complementary_info.command` what the operator asked for,
`complementary_info.is_intervention` whether these differ. `meta/episodes` says of each episode who
drove, in which world, and what came out.
"""


@dataclass(frozen=True, eq=False)
class Column:
    """The values of a feature in T frames: numbers [T] or [T, N], or images uint8 [T, H, W, 3]."""

    values: NDArray[Any]
    names: tuple[str, ...] | None = None

    @property
    def is_image(self) -> bool:
        """Whether these are images."""
        return self.values.ndim == 4

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of a value; (1,) of a plain number."""
        return self.values.shape[1:] or (1,)

    def empty(self) -> Column:
        """Return the same feature without values."""
        return Column(self.values[:0], self.names)

    def feature(self) -> dict[str, Any]:
        """Return the entry of `meta/info.json`."""
        kind = "image" if self.is_image else str(self.values.dtype)
        names = None if self.names is None else list(self.names)
        return {"dtype": kind, "shape": list(self.shape), "names": names}

    def hub_feature(self) -> dict[str, Any]:
        """Return how the library `datasets` calls the type of the column."""
        if self.is_image:
            return {"_type": "Image"}
        value = {"dtype": str(self.values.dtype), "_type": "Value"}
        if self.shape == (1,):
            return value
        return {"feature": value, "length": self.shape[0], "_type": "Sequence"}

    def arrow_type(self) -> pa.DataType:
        """Return the type of the column. A vector of one number is a plain number."""
        if self.is_image:
            return IMAGE
        number = pa.from_numpy_dtype(self.values.dtype)
        return number if self.shape == (1,) else pa.list_(number, self.shape[0])

    def arrow(self) -> pa.Array:
        """Return the values as a column."""
        if self.is_image:
            images = [{"bytes": _png(image), "path": None} for image in self.values]
            return pa.array(images, IMAGE)
        flat = pa.array(np.ascontiguousarray(self.values).ravel())
        if self.shape == (1,):
            return flat
        return pa.FixedSizeListArray.from_arrays(flat, self.shape[0])

    def stats(self) -> Stats | None:
        """Return the statistics of the values; None where one of them is undefined."""
        return image_stats(self.values) if self.is_image else number_stats(self.values)


def frame_columns(episode: Episode, cameras: int) -> dict[str, Column]:
    """Return the features of T frames, by name, without the indices.

    Args:
        episode: with what was seen, or without.
        cameras: how many of the two images there are.
    """
    columns: dict[str, Column] = {}
    if episode.sees == PIXELS:
        assert episode.seen is not None
        for camera, name in enumerate(CAMERAS[:cameras]):
            image = episode.seen[:-1, 3 * camera : 3 * camera + 3]
            channels_last = np.ascontiguousarray(np.moveaxis(image, 1, -1))
            columns[name] = Column(channels_last, ("height", "width", "channels"))
    elif episode.seen is not None:
        columns[VECTOR] = Column(episode.seen[:-1])
    done = np.zeros(episode.decisions, np.bool_)
    done[-1] = True
    columns |= {
        "action": Column(episode.action),
        "next.reward": Column(episode.reward),
        "next.done": Column(done),
        "next.truncated": Column(done & (not episode.terminated)),
        INTERVENTION: Column(episode.intervened.astype(np.float32)),
        f"{INFO}.command": Column(episode.command),
        f"{INFO}.gate": Column(episode.gate.astype(np.int64)),
        f"{INFO}.cost": Column(episode.cost_env),
        f"{INFO}.goals": Column(episode.goals),
        f"{INFO}.predicted_cost": Column(episode.predicted_cost),
        f"{INFO}.predicted_gain": Column(episode.predicted_gain),
        f"{INFO}.signal": Column(episode.signal),
    }
    if episode.privileged is not None:
        columns[f"{INFO}.privileged"] = Column(episode.privileged[:-1])
    return columns


def _schema(columns: Mapping[str, Column]) -> pa.Schema:
    """The schema of a data file, with what the library `datasets` reads of it."""
    features = {name: column.hub_feature() for name, column in columns.items()}
    metadata = {"huggingface": json.dumps({"info": {"features": features}})}
    return pa.schema([(name, column.arrow_type()) for name, column in columns.items()], metadata)


def _png(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def _file_place(file: int) -> dict[str, int]:
    """Folder and number of the file of a number."""
    return {"chunk_index": file // CHUNK, "file_index": file % CHUNK}


def _write_episodes(rows: list[dict[str, Any]], path: Path) -> None:
    """Write a row per episode; a statistic that an episode does not have is null."""
    names = dict.fromkeys(name for row in rows for name in row)
    table = pa.table({name: [row.get(name) for row in rows] for name in names})
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _write_tasks(tasks: list[str], path: Path) -> None:
    """Write the tasks in words as pandas writes a table whose index they are."""
    columns = {"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks)}
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    described = [
        {
            "name": name,
            "field_name": name,
            "pandas_type": pandas_type,
            "numpy_type": numpy_type,
            "metadata": None,
        }
        for name, (pandas_type, numpy_type) in kinds.items()
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": described,
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    table = pa.table(columns).replace_schema_metadata({"pandas": json.dumps(pandas)})
    pq.write_table(table, path)


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=4) + "\n", encoding="utf-8")
