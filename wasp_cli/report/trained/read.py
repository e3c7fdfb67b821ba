"""Read the files of trained artifacts with care: a results folder may be untrusted. What has no valid form reads as nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wasp_cli.errors import WaspError
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import LARGEST, open_plain, parse, read_plain

Floats = NDArray[np.float64]
PIXELS = (6, 64, 64)
"""Of a frame: front RGB, then rear RGB."""
UNREADABLE = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError, RecursionError, pa.ArrowException, WaspError)
"""What reading, or showing, a file of another form may raise."""


def read_json(layout: Layout, artifact: Trained, name: str) -> Any:
    """Return what a JSON file of an artifact says; None where there is none or it does not read."""
    with suppress(OSError, ValueError, RecursionError, WaspError):
        return parse(read_plain(layout.within(layout.artifact(artifact.kind, artifact.key) / name)))
    return None


def config_of(layout: Layout, artifact: Trained) -> Mapping[str, Any]:
    """Return the configuration of an artifact's stage; an empty one where the manifest has none."""
    config = read_manifest(layout, artifact.kind, artifact.key).get("config")
    return config if isinstance(config, dict) else {}


@contextmanager
def open_parquet(layout: Layout, path: Path) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file of an artifact.

    Raises:
        OSError, StoreError, pyarrow.ArrowException: there is none, it is a link or no plain file, or it is damaged.
    """
    with open_plain(layout.within(path)) as plain, pq.ParquetFile(plain) as file:
        yield file


def read_table(layout: Layout, artifact: Trained, name: str, columns: Sequence[str], most: int) -> pa.Table:
    """Read a small Parquet file of an artifact.

    Args:
        layout: the results folder.
        artifact: whose file it is.
        name: of the file.
        columns: that are read.
        most: rows that it may have.

    Raises:
        ValueError: it is too large.
        OSError, StoreError, pyarrow.ArrowException: as `open_parquet`.
    """
    with open_parquet(layout, layout.artifact(artifact.kind, artifact.key) / name) as file:
        size = sum(file.metadata.row_group(i).total_byte_size for i in range(file.num_row_groups))
        if file.metadata.num_rows > most or size > LARGEST:
            raise ValueError(f"{name} has {file.metadata.num_rows} rows and {size} bytes")
        return file.read(columns=list(columns), use_threads=False)


def rows_of(value: Any) -> list[Mapping[str, Any]]:
    """Return the mappings of a list; none where the value is no list."""
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def column_of(rows: Sequence[Mapping[str, Any]], name: str) -> Floats:
    """Return a number of every row: [n], NaN where it is none."""
    return numbers_of([row.get(name) for row in rows])


def numbers_of(values: Any) -> Floats:
    """Return real numbers: [n], NaN where a value is none; empty where the value is no list."""
    if not isinstance(values, list):
        return np.empty(0)
    plain = [float(value) if isinstance(value, int | float) else math.nan for value in values]
    found = np.array(plain, np.float64)
    return np.where(np.isfinite(found), found, np.nan)
