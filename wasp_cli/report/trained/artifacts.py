"""What was trained for a report: one row per artifact, and what is damaged.

A results folder may be untrusted: files of another form are treated as absent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli import console
from wasp_cli.cells.table import Floats
from wasp_cli.errors import ArtifactError, WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.report.provenance import Origins, is_from_published
from wasp_cli.report.render import markdown_row, markdown_text
from wasp_cli.report.tables import task_title
from wasp_cli.stages.registry import stages_of
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import open_plain, parse, read_plain
from wasp_cli.store.severities import SEVERITY
from wasp_cli.tasks.declared import declare_from
from wasp_cli.tasks.registry import TASKS

SHOWN = 24  # numbers of a stage that fit on a line; the manifests have all

NOT_TRAINED = ("evaluate", *stages_of("cell"))  # kinds whose results are tables of their own


MALFORMED = (
    KeyError,
    TypeError,
    ValueError,
    OverflowError,
    AttributeError,
    RecursionError,
    WaspError,
)
"""What reading a manifest of another form may raise."""


@dataclass(frozen=True)
class Trained:
    """One trained part, as a report has it."""

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
    """Find artifacts and everything that they were computed from, without evaluated cells.

    Args:
        roots: kinds and keys. Those that are not there yet are passed over.
        origins: counts every artifact, evaluated cells too.

    Returns:
        The artifacts, needed ones first; and a sentence for each that is damaged.
    """
    origins = origins or Origins()
    visited: set[str] = set()
    artifacts: list[Trained] = []
    damaged: list[str] = []

    def visit(kind: str, key: str) -> None:
        if key in visited or not layout.manifest(kind, key).is_file():
            return
        visited.add(key)
        try:
            manifest = read_manifest(layout, kind, key)
        except ArtifactError as error:
            damaged.append(error.message)
            return
        try:
            for name, needed in manifest["upstream"].items():
                visit(manifest["upstream_kinds"][name], needed)
            artifact = _trained(kind, key, manifest)
            origins.add(manifest)
        except MALFORMED as error:
            what = " ".join(str(error).split())
            if isinstance(error, KeyError):
                what = f"no '{error.args[0]}'"
            damaged.append(f"'{layout.manifest(kind, key)}' is damaged: {what}")
            return
        if kind not in NOT_TRAINED:
            artifacts.append(artifact)

    for kind, key in roots:
        visit(kind, key)
    return tuple(artifacts), tuple(damaged)


def _trained(kind: str, key: str, manifest: Mapping[str, Any]) -> Trained:
    """An artifact by its manifest. Raises one of MALFORMED if the manifest has another form."""
    stage = kind
    method = manifest["axes"].get("method")
    if method in METHODS:
        stage = f"{kind} of {METHODS[method].title}"
    operator = manifest["axes"].get("operator")
    if kind == SEVERITY and operator in OPERATORS:
        stage = f"{kind} of {OPERATORS[operator].title}"
    if is_from_published(manifest):
        stage += ", published"
    declare_from(manifest["task"], manifest.get("settings"))
    seconds = manifest["provenance"].get("seconds")
    return Trained(
        stage=stage,
        task=TASKS[manifest["task"]].name,
        seed=int(manifest["seed"]),
        key=key,
        seconds=None if seconds is None else float(seconds),
        summary=dict(manifest["summary"]),
        kind=kind,
    )


def trained_markdown(artifacts: Iterable[Trained]) -> str:
    """Return the table of what was trained as Markdown, a row for each artifact."""
    lines = [
        "## What was trained",
        "",
        "| Task | Seed | Stage | Time | Numbers | Key |",
        "| --- | ---: | --- | ---: | --- | --- |",
    ]
    for artifact in artifacts:
        cells = (
            task_title(artifact.task),
            artifact.seed,
            artifact.stage,
            duration(artifact.seconds),
            markdown_text(numbers_text(artifact.summary)),
            f"`{artifact.key[:8]}`",
        )
        lines.append(markdown_row(cells))
    return "\n".join(lines) + "\n"


def numbers_text(summary: Mapping[str, Any]) -> str:
    """Return the first numbers of a summary on one line, and how many more there are."""
    numbers = list(scalars(summary))
    text = ", ".join(f"{name} {short(value)}" for name, value in numbers[:SHOWN])
    return text + (f", and {len(numbers) - SHOWN} more" if len(numbers) > SHOWN else "")


def duration(seconds: float | None) -> str:
    """Return a duration in words; `?` where it is not known."""
    return "?" if seconds is None or not math.isfinite(seconds) else console.duration(seconds)


def scalars(
    summary: Mapping[str, Any], prefix: str = ""
) -> Iterable[tuple[str, int | float | bool | str]]:
    """Yield the numbers and texts of a summary by name; `a.b` of those in mappings."""
    for name, value in summary.items():
        if isinstance(value, Mapping):
            yield from scalars(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float | str):
            yield f"{prefix}{name}", value


def short(value: int | float | bool | str) -> str:
    """Return a number of a summary with four digits, anything else as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


PIXELS = (6, 64, 64)  # of a frame: front RGB, then rear RGB
UNREADABLE = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    OSError,
    RecursionError,
    pa.ArrowException,
    WaspError,
)
"""What reading, or showing, a file of another form may raise."""


def read_json(layout: Layout, artifact: Trained, name: str) -> Any:
    """Return the content of a JSON file of an artifact; None if it is missing or cannot be read."""
    with suppress(OSError, ValueError, RecursionError, WaspError):
        return parse(read_plain(layout.within(layout.artifact(artifact.kind, artifact.key) / name)))
    return None


def read_table(layout: Layout, artifact: Trained, name: str, columns: Sequence[str]) -> pa.Table:
    """Return some columns of a Parquet file of an artifact. Raises one of UNREADABLE."""
    path = layout.within(layout.artifact(artifact.kind, artifact.key) / name)
    with open_plain(path) as plain, pq.ParquetFile(plain) as file:
        return file.read(columns=list(columns), use_threads=False)


def column_of(rows: Sequence[Mapping[str, Any]], name: str) -> Floats:
    """Return a number of every row: [n], NaN where there is none."""
    return np.array([row.get(name) for row in rows], np.float64)
