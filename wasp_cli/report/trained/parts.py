"""What was trained for a report: one row per artifact, with the numbers that its stage found worth showing.

Files of artifacts are read with care: a results folder may be untrusted. What has no valid form reads as nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wasp_cli.errors import ArtifactError, WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.provenance import Origins, is_from_published
from wasp_cli.report.render import markdown_row
from wasp_cli.report.tables.table import task_title
from wasp_cli.stages.registry import stages_of
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import open_plain, parse, read_plain
from wasp_cli.tasks.registry import TASKS

SHOWN = 24  # numbers of a stage that fit on a line; the manifests have all

NOT_TRAINED = ("evaluate", *stages_of("cell"))  # kinds whose results are tables of their own


@dataclass(frozen=True)
class Trained:
    stage: str
    task: str
    seed: int
    key: str
    seconds: float | None
    summary: Mapping[str, Any]
    kind: str = ""  # of its node; `stage` says more, for people


def trained_artifacts(
    layout: Layout, roots: Iterable[tuple[str, str]], origins: Origins | None = None
) -> tuple[tuple[Trained, ...], tuple[str, ...]]:
    """Find artifacts and what is behind them, needed ones first, without evaluated cells; and what is damaged.

    `roots` are kinds and keys; one that is not there yet is passed over. `origins` takes every artifact into account, evaluated cells too.
    """
    origins = origins or Origins()
    artifacts: dict[str, Trained | None] = {}
    damaged: list[str] = []

    def visit(kind: str, key: str) -> None:
        if key in artifacts or not layout.manifest(kind, key).is_file():
            return
        artifacts[key] = None
        try:
            manifest = read_manifest(layout, kind, key)
        except ArtifactError as error:
            damaged.append(error.message)
            return
        try:
            kinds = manifest.get("upstream_kinds", {})  # older manifests name artifacts by kind
            for name, needed in manifest["upstream"].items():
                visit(kinds.get(name, name), needed)
            method = manifest["axes"].get("method")
            stage = f"{kind} of {METHODS[method].title}" if method in METHODS else kind
            stage += ", published" if is_from_published(manifest) else ""
            task, seed, summary = TASKS[manifest["task"]].name, int(manifest["seed"]), dict(manifest["summary"])
            seconds = manifest["provenance"].get("seconds")
            trained = Trained(stage, task, seed, key, None if seconds is None else float(seconds), summary, kind)
            origins.add(manifest)
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError, RecursionError, WaspError) as error:
            what = f"no '{error.args[0]}'" if isinstance(error, KeyError) else " ".join(str(error).split())
            damaged.append(f"'{layout.manifest(kind, key)}' is damaged: {what}")
            return
        del artifacts[key]  # so that it stands behind what it needs
        artifacts[key] = trained if kind not in NOT_TRAINED else None

    for kind, key in roots:
        visit(kind, key)
    return tuple(artifact for artifact in artifacts.values() if artifact is not None), tuple(damaged)


def trained_markdown(artifacts: Iterable[Trained]) -> str:
    lines = ["## What was trained", "", "| Task | Seed | Stage | Time | Numbers | Key |", "| --- | ---: | --- | ---: | --- | --- |"]
    for artifact in artifacts:
        numbers, time = numbers_text(artifact.summary), duration(artifact.seconds)
        lines.append(markdown_row((task_title(artifact.task), artifact.seed, artifact.stage, time, numbers, f"`{artifact.key[:8]}`")))
    return "\n".join(lines) + "\n"


def numbers_text(summary: Mapping[str, Any]) -> str:
    numbers = list(scalars(summary))
    text = ", ".join(f"{name} {short(value)}" for name, value in numbers[:SHOWN])
    return text + (f", and {len(numbers) - SHOWN} more" if len(numbers) > SHOWN else "")


def duration(seconds: float | None) -> str:
    """Write a time: `41 s`, `3 min 20 s`, `2 h 05 min`."""
    if seconds is None or not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def scalars(summary: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, int | float | bool | str]]:
    for name, value in summary.items():
        if isinstance(value, Mapping):
            yield from scalars(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float | str):
            yield f"{prefix}{name}", value


def short(value: int | float | bool | str) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


Floats = NDArray[np.float64]
PIXELS = (6, 64, 64)  # of a frame: front RGB, then rear RGB
UNREADABLE = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError, RecursionError, pa.ArrowException, WaspError)
"""What reading, or showing, a file of another form may raise."""


def read_json(layout: Layout, artifact: Trained, name: str) -> Any:
    """Return what a JSON file of an artifact says; None where there is none or it does not read."""
    with suppress(OSError, ValueError, RecursionError, WaspError):
        return parse(read_plain(layout.within(layout.artifact(artifact.kind, artifact.key) / name)))
    return None


@contextmanager
def open_parquet(layout: Layout, path: Path) -> Iterator[pq.ParquetFile]:
    with open_plain(layout.within(path)) as plain, pq.ParquetFile(plain) as file:
        yield file


def read_table(layout: Layout, artifact: Trained, name: str, columns: Sequence[str]) -> pa.Table:
    with open_parquet(layout, layout.artifact(artifact.kind, artifact.key) / name) as file:
        return file.read(columns=list(columns), use_threads=False)


def column_of(rows: Sequence[Mapping[str, Any]], name: str) -> Floats:
    """Return a number of every row: [n], NaN where there is none."""
    return np.array([row.get(name) for row in rows], np.float64)
