"""A small board, and a submission to it whose rows are invented: everything else is real."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tests.commands import ROOT
from tests.report.invented import invent
from wasp_cli import seeds
from wasp_cli.leaderboard.board import Board, board_of
from wasp_cli.leaderboard.cells import nodes_of
from wasp_cli.leaderboard.entry import Entry, entry_of
from wasp_cli.leaderboard.folder import SUBMISSION, code_hash
from wasp_cli.leaderboard.submit import write_submission
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.plan.node import Node
from wasp_cli.plan.planned import planned
from wasp_cli.run.runner import Summary
from wasp_cli.run.session import Session
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import commit, file_digest, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, Thresholds, write_cell

EXAMPLES = ROOT / "docs" / "examples"
HALFWAY = EXAMPLES / "halfway.yaml"

SMALL = """\
extends: field
name: small
tasks: [race1, goal1]
operators: {noisy: null, limited-skill: null, reaction-time: null}
seeds: [313, 314]
episodes: 3
"""


TRAINED = ("heldout",)
"""Kinds of parts that nobody has published, and that a session has computed."""


def small_board(folder: Path) -> Path:
    """Write the spec of a board of two tasks, an operator and two seeds."""
    path = folder / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return path


def halfway(board: Board) -> Entry:
    """The assistant of the page for newcomers, on a board."""
    settings = [f"episodes={board.spec.episodes}", "operators={laggy: {moderate: 0.7}}"]
    return entry_of(load(HALFWAY, settings), board)


def session_of(entry: Entry, board: Board, results: Path) -> Session:
    """A run that has computed every cell of a submission, as a worker would leave them."""
    plan = planned(entry.loaded, results, reuse=str(board.published))
    layout = Layout(results)
    layout.prepare()
    for cell, node in nodes_of(plan.grid).items():
        _commit(layout, cell, node, board.spec.episodes)
    for node in plan.grid.nodes:
        if node.kind in TRAINED:
            staging = staging_folder(layout, node.key)
            (staging / "numbers.json").write_text("{}", encoding="utf-8")
            commit(layout, node.kind, node.key, staging, manifest_of(node))
    return Session(layout, "", plan, Summary(), {})


def _commit(layout: Layout, cell: CellIdentity, node: Node, episodes: int) -> None:
    driven = [invent(3 * e + cell.seed, e % 5, 0.2, 0.1) for e in range(episodes)]
    staging = staging_folder(layout, node.key)
    write_cell(
        staging,
        cell,
        driven,
        [episode_metrics(each, 3, 25.0) for each in driven],
        Thresholds(),
        [each.reward * 0 + 1 for each in driven],
        [seeds.layout_seed(cell.task, cell.seed, e) for e in range(episodes)],
    )
    commit(layout, node.kind, node.key, staging, manifest_of(node))


def manifest_of(node: Node) -> dict[str, Any]:
    """The part of a worker's manifest that a submission reads."""
    return {
        "key": node.key,
        "label": node.label,
        "sources": node.sources,
        "provenance": {
            "wasp": "0.3.0",
            "started_at": "2026-12-01T10:00:00+00:00",
            "seconds": 2.5,
            "host": "a-private-name",
        },
    }


def submitted(folder: Path) -> tuple[Path, Path]:
    """Write a submission to the small board; returns its folder and the spec of the board."""
    spec = small_board(folder)
    board = board_of(spec)
    entry = halfway(board)
    place = folder / "halfway"
    write_submission(
        session_of(entry, board, folder / "results"), entry, board, place, by="Somebody"
    )
    return place, spec


def record_of(folder: Path) -> dict[str, Any]:
    """What `submission.json` says."""
    record: dict[str, Any] = json.loads((folder / SUBMISSION).read_text(encoding="utf-8"))
    return record


def rewrite(folder: Path, **changes: Any) -> None:
    """Change entries of `submission.json`."""
    text = json.dumps({**record_of(folder), **changes})
    (folder / SUBMISSION).write_text(text, encoding="utf-8")


def sign(folder: Path) -> None:
    """Let `submission.json` list the files as they are now, as somebody would who cheats."""
    names = [name for name in record_of(folder)["files"] if (folder / name).is_file()]
    files = {name: file_digest(folder / name) for name in names}
    sources: Mapping[str, str] = {
        name.removeprefix("source/"): digest
        for name, digest in files.items()
        if name.startswith("source/")
    }
    rewrite(folder, files=files, sources=dict(sources), code=code_hash(sources))


def copied(folder: Path, to: Path) -> Path:
    """A copy of a submission, to be changed."""
    return Path(shutil.copytree(folder, to / folder.name))
