"""Cells of a submission computed again: do the rows follow from its source and the published
models, to the bit?

The cells are put into a results folder of their own, beside the models that they were computed
from, and verified there as any others (`run.verify`). Their configuration comes from the board and
the spec of the submission, never from what the submission says of itself.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import chdir
from pathlib import Path
from typing import Any

import pyarrow as pa

from wasp_cli.errors import ArtifactError
from wasp_cli.leaderboard.board import Board
from wasp_cli.leaderboard.cells import nodes_of
from wasp_cli.leaderboard.entry import entry_from
from wasp_cli.leaderboard.folder import SOURCE, SPEC, Submission
from wasp_cli.plan.node import Node
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.plan.source import own_files
from wasp_cli.run.verify import Answer, own_code, verify
from wasp_cli.store import artifact
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import write_table
from wasp_cli.store.published import Offer, import_artifact
from wasp_cli.store.tables import (
    EPISODES_FILE,
    SCHEMA,
    STEPS_FILE,
    STEPS_SCHEMA,
    CellIdentity,
    write_episodes,
)

EVALUATE = "evaluate"


def answers(
    folder: Path,
    submission: Submission,
    rows: Mapping[CellIdentity, pa.Table],
    board: Board,
    cells: Sequence[CellIdentity],
    jobs: int,
) -> Iterator[Answer]:
    """Compute cells of a submission again, and yield for each whether its rows are the same.

    The source of the submission is imported and runs in this process or in its workers, with the
    rights of whoever calls this.

    Args:
        folder: of the submission, which `check.checked` has passed.
        submission: what is in it.
        rows: the episodes of its cells.
        board: that it was submitted to.
        cells: which ones.
        jobs: processes at most.

    Raises:
        ArtifactError: the assistant that is found here is other code than was submitted, or a part
            that was trained for it is missing.
        InvalidSpec: its spec is invalid here.
    """
    folder = folder.absolute()
    text = (folder / SPEC).read_text(encoding="utf-8")
    with (
        tempfile.TemporaryDirectory(prefix="wasp-verify-") as temporary,
        # where modules of one's own are looked for, by this process and by workers
        chdir(_copied_source(folder, Path(temporary))),
    ):
        entry = entry_from(text, str(folder / SPEC), board)
        layout = Layout(Path(temporary) / "results")
        layout.prepare()
        grid = lay_out_over(entry.loaded.spec, layout, str(board.published))
        nodes = nodes_of(grid)
        _check_code(nodes[cells[0]], submission)
        offers = {key: reused.offer for key, reused in grid.reused.items()}
        trained = Layout(folder)
        for cell in cells:
            upstream = {
                name: _brought(need, layout, trained, offers)
                for name, need in nodes[cell].needs.items()
            }
            _store(layout, nodes[cell], rows[cell], upstream, submission.provenance)
        own = own_code(entry.loaded.spec)
        yield from verify(layout, [nodes[cell].key for cell in cells], jobs, own)


def _copied_source(folder: Path, temporary: Path) -> Path:
    """A copy of the source of a submission, or the current folder if it has none. What its code, or
    an environment, writes into its folder must not become a file of the submission.
    """
    source = folder / SOURCE
    if not source.is_dir():
        return Path.cwd()
    return shutil.copytree(source, temporary / SOURCE)


def _check_code(node: Node, submission: Submission) -> None:
    """Raise an ArtifactError where the assistant that was imported is not what was submitted."""
    found = {
        name: artifact.file_digest(path)
        for name, path in own_files(node.modules, node.without).items()
    }
    if found != dict(submission.sources):
        changed = sorted(
            name
            for name in {*found, *submission.sources}
            if found.get(name) != submission.sources.get(name)
        )
        raise ArtifactError(
            f"'{submission.assistant}' is other code here than was submitted: {', '.join(changed)}",
            "run in a folder with the submitted files, and uninstall other modules of these names",
        )
    here = node.sources
    stale = [name for name, text in submission.modules.items() if here.get(name) != text]
    if stale:
        raise ArtifactError(
            f"the rows were computed by other code than the source beside them: "
            f"{', '.join(sorted(stale))}"
        )


def _brought(
    node: Node, layout: Layout, trained: Layout, offers: Mapping[str, Offer]
) -> tuple[str, str]:
    """Bring what a cell reads into the results folder; returns its kind and key there."""
    if node.key in offers:
        import_artifact(layout, offers[node.key], lambda: True)
        return node.kind, node.key
    # Of another version of wasp it has another key; a submission has one of a kind and task.
    for key in artifact.artifact_keys(trained, node.kind):
        manifest = artifact.read_manifest(trained, node.kind, key)
        if manifest.get("task") == node.task:
            offer = Offer(trained, node.kind, key, node.recipe, {}, manifest)
            import_artifact(layout, offer, lambda: True)
            return node.kind, key
    raise ArtifactError(f"what was trained for the assistant is not in the folder: {node.label}")


def _store(
    layout: Layout,
    node: Node,
    rows: pa.Table,
    upstream: Mapping[str, tuple[str, str]],
    provenance: Mapping[str, Any],
) -> None:
    """Write a submitted cell into the results folder, as a run would have."""
    staging = artifact.staging_folder(layout, node.key)
    write_episodes(rows.cast(SCHEMA), staging / EPISODES_FILE)
    write_table(STEPS_SCHEMA.empty_table(), staging / STEPS_FILE)
    manifest = {
        "kind": EVALUATE,
        "key": node.key,
        "label": node.label,
        "task": node.task,
        "seed": node.seed,
        "axes": node.axes,
        "config": node.config,
        "settings": node.settings,
        "upstream": {name: key for name, (_, key) in upstream.items()},
        "upstream_kinds": {name: kind for name, (kind, _) in upstream.items()},
        "sources": {},
        "summary": {},
        "provenance": dict(provenance),
    }
    artifact.commit(layout, EVALUATE, node.key, staging, manifest, copied=True)
