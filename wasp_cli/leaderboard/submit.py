"""From a spec to the folder of a submission: compute the cells of the board, then write them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wasp_cli.console import size
from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.leaderboard.board import Board
from wasp_cli.leaderboard.cells import label_of, nodes_of, sample_of
from wasp_cli.leaderboard.entry import Entry
from wasp_cli.leaderboard.folder import (
    FORM,
    ROWS,
    SOURCE,
    SPEC,
    code_hash,
    complete,
    new_folder,
    require_free,
)
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.node import Node, with_upstream
from wasp_cli.plan.offered import Listing
from wasp_cli.plan.planned import planned
from wasp_cli.plan.source import PACKAGE, own_files
from wasp_cli.run.publish import PUBLIC
from wasp_cli.run.session import RunOptions, Session, run_spec
from wasp_cli.store import artifact
from wasp_cli.store.layout import MANIFEST, Layout
from wasp_cli.store.parquet import write_table
from wasp_cli.store.published import commit_of, copy_files
from wasp_cli.store.records import write_record
from wasp_cli.store.tables import SCHEMA, cell_file, read_episodes

LARGEST = 50_000_000
"""Bytes at most of what was trained for an assistant: a submission lies in git."""


def computed(entry: Entry, board: Board, results: Path, options: RunOptions) -> Session:
    """Compute what is missing of a submission's cells, with the published models.

    Raises:
        UsageError: the results folder has models of its own where the board has published ones.
        CellsFailed: a cell failed.
        Interrupted: Ctrl-C; the same command goes on.
    """
    reuse = str(board.published)
    _require_published(planned(entry.loaded, results, reuse=reuse).grid, board)
    session = run_spec(entry.loaded, results, options, reuse=reuse)
    session.require_complete()
    return session


def _require_published(grid: Grid, board: Board) -> None:
    """Raise a UsageError where a cell would be computed with other models than the published."""
    published = {entry.recipe for entry in Listing(Layout(board.published)).usable}
    read = with_upstream(node for _, cell in grid.cells for node in cell.needs.values())
    others = [
        node.label for node in read if node.recipe in published and node.key not in grid.reused
    ]
    if others:
        raise UsageError(
            f"these results have models of their own where the board has published ones: "
            f"{', '.join(others)}",
            "name a new results folder: --results DIR",
        )


def write_submission(
    session: Session,
    entry: Entry,
    board: Board,
    place: Path,
    *,
    by: str,
    source: bool = True,
    force: bool = False,
) -> None:
    """Write the folder of a submission from a run of all its cells.

    Args:
        session: the run, from `computed`.
        entry: what is submitted.
        board: to which.
        place: the folder.
        by: who submits.
        source: whether the assistant's files go along; their hashes always do.
        force: whether a submission that is there is replaced.

    Raises:
        ArtifactError: a cell is missing or damaged.
        UsageError: something is at `place`; files of the assistant lie in different places; or
            what was trained for it is too large.
    """
    require_free(place, force=force)
    layout = session.layout
    listed = board.cells(entry.method)
    by_cell = nodes_of(session.plan.grid)
    cells = [by_cell[cell] for cell in listed]
    manifests = [_whole_manifest(layout, node) for node in cells]
    sources = own_files(cells[0].modules, cells[0].without)
    for name in sources:
        if not artifact.is_file_name(name):
            raise UsageError(
                f"'{sources[name]}' lies outside of the folder of its module, and cannot go along",
                "keep an assistant's files in one folder",
            )
    with new_folder(place, force=force) as folder:
        paths = [cell_file(layout.artifact(node.kind, node.key)) for node in cells]
        write_table(read_episodes(paths).cast(SCHEMA), folder / ROWS)
        (folder / SPEC).write_text(entry.text, encoding="utf-8")
        _copy_trained(layout, cells, folder, session.plan.grid)
        digests = {name: artifact.file_digest(path) for name, path in sources.items()}
        if source:
            _copy_source(sources, folder / SOURCE)
        sample = sample_of(listed, artifact.file_digest(folder / ROWS))
        provenance = manifests[0]["provenance"]
        submission = {
            "form": FORM,
            "name": place.name,
            "assistant": entry.method,
            "title": METHODS[entry.method].title,
            "by": by,
            "when": max(str(each["provenance"]["started_at"])[:10] for each in manifests),
            "wasp": str(provenance["wasp"]),
            "commit": commit_of(manifests[0]).strip(" ()"),
            "board": board.digest,
            "code": code_hash(digests),
            "sources": digests,
            "modules": _own_modules(manifests[0]["sources"]),
            "keys": {label_of(cell): node.key for cell, node in zip(listed, cells, strict=True)},
            "sample": [label_of(cell) for cell in sample],
            "seconds": round(sum(float(each["provenance"]["seconds"]) for each in manifests), 1),
            "provenance": _public(provenance),
        }
        complete(folder, submission)


def _whole_manifest(layout: Layout, node: Node) -> Mapping[str, Any]:
    """The manifest of a cell whose bytes are those that were stored."""
    wrong = artifact.corruption(layout, node.kind, node.key)
    if wrong is not None:
        raise ArtifactError(
            f"the run is unfinished: {node.label}: {wrong}", "run wasp submit again"
        )
    return artifact.read_manifest(layout, node.kind, node.key)


def _own_modules(hashes: Mapping[str, str]) -> dict[str, str]:
    return {name: text for name, text in hashes.items() if name.split(".")[0] != PACKAGE}


def _public(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """What a manifest tells of processor and libraries, without the name of a machine."""
    return {name: provenance[name] for name in PUBLIC if name in provenance}


def _copy_source(sources: Mapping[str, Path], folder: Path) -> None:
    for name, path in sources.items():
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)


def _copy_trained(layout: Layout, cells: Sequence[Node], folder: Path, grid: Grid) -> None:
    """Copy what the cells read and nobody has published: what was trained for this assistant."""
    needed = {need.key: need for node in cells for need in node.needs.values()}
    trained = {
        node: artifact.read_manifest(layout, node.kind, node.key)
        for node in needed.values()
        if node.key not in grid.reused
    }
    total = sum(
        sum(artifact.listed_files(manifest, layout.manifest(node.kind, node.key)).values())
        for node, manifest in trained.items()
    )
    if total > LARGEST:
        raise UsageError(
            f"what the assistant reads and nobody has published has {size(total)}, and a "
            f"submission holds {size(LARGEST)}: {', '.join(node.label for node in trained)}",
            "read large inputs in a stage of your own, and keep what it learns",
        )
    copies = Layout(folder)
    for node, manifest in trained.items():
        place = copies.artifact(node.kind, node.key)
        place.mkdir(parents=True)
        copy_files(layout, node.kind, node.key, manifest, place)
        provenance = _public(manifest["provenance"])
        write_record(place / MANIFEST, {**manifest, "provenance": provenance})
