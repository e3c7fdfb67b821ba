"""Exported datasets read again: those of Minari by Minari, those of LeRobot as its format says."""

import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
from PIL import Image


class Frames(NamedTuple):
    """A dataset of LeRobot, as arrays of all its frames."""

    info: dict[str, Any]
    columns: dict[str, Any]
    """[N, ...] by feature; images are [N, H, W, 3]."""
    episodes: list[dict[str, Any]]
    stats: dict[str, Any]

    def of(self, episode: int) -> dict[str, Any]:
        """The frames of an episode."""
        row = self.episodes[episode]
        part = slice(row["dataset_from_index"], row["dataset_to_index"])
        return {name: values[part] for name, values in self.columns.items()}


def read_lerobot(folder: Path) -> Frames:
    """Read a dataset by what its `info.json` says, and hold the indices against each other."""
    info = json.loads((folder / "meta/info.json").read_text())
    paths = sorted((folder / "data").glob("*/*.parquet"))
    tables = [pq.read_table(path) for path in paths]
    columns: dict[str, Any] = {}
    for name, feature in info["features"].items():
        values = [value for table in tables for value in table[name].to_pylist()]
        if feature["dtype"] == "image":
            columns[name] = np.stack(
                [np.array(Image.open(io.BytesIO(value["bytes"]))) for value in values]
            )
        else:
            columns[name] = np.array(values, feature["dtype"])
            shape = tuple(feature["shape"])
            assert columns[name].shape[1:] == (() if shape == (1,) else shape), name
    (path,) = (folder / "meta/episodes").glob("*/*.parquet")
    episodes = pq.read_table(path).to_pylist()
    stats = json.loads((folder / "meta/stats.json").read_text())
    assert info["total_frames"] == len(columns["index"])
    assert info["total_episodes"] == len(episodes)
    assert columns["index"].tolist() == list(range(info["total_frames"]))
    assert all(
        pq.ParquetFile(path).num_row_groups == len(set(table["episode_index"].to_pylist()))
        for path, table in zip(paths, tables, strict=True)
    )
    return Frames(info, columns, episodes, stats)
