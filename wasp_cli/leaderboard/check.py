"""Is a submission whole, and about the worlds of the board? Nothing of it is executed."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa

from wasp_cli import seeds
from wasp_cli.errors import ArtifactError
from wasp_cli.leaderboard.board import Board
from wasp_cli.leaderboard.cells import label_of, sample_of
from wasp_cli.leaderboard.folder import ROWS, Submission, read_submission, rows_of
from wasp_cli.methods.registry import METHODS
from wasp_cli.store.tables import CellIdentity


def checked(folder: Path, board: Board) -> tuple[Submission, dict[CellIdentity, pa.Table]]:
    """Return a submission with the episodes of its cells, in the order of the board.

    Raises:
        UsageError: the folder holds no submission.
        ArtifactError: a file was changed, a cell is missing, rows are of other worlds; or the
            submission is to another board.
        StoreError: the rows cannot be read.
    """
    submission = read_submission(folder)
    if submission.board != board.digest:
        raise ArtifactError(
            f"'{folder}' was submitted to another board: other tasks, operators, seeds or episodes",
            "--board SPEC names the board that it was submitted to",
        )
    if submission.assistant in METHODS.own:
        raise ArtifactError(f"'{folder}' is of '{submission.assistant}', which comes with wasp")
    rows = rows_of(folder)
    path = folder / ROWS
    cells = board.cells(submission.assistant)
    missing = [label_of(cell) for cell in cells if cell not in rows]
    if missing:
        raise ArtifactError(
            f"'{path}' lacks {len(missing)} of {len(cells)} cells: {_few(missing)}",
            "a submission has every cell of the board: wasp submit SPEC --force",
        )
    others = [label_of(cell) for cell in rows if cell not in cells]
    if others:
        raise ArtifactError(f"'{path}' has cells that are not the board's: {_few(others)}")
    for cell in cells:
        _check_worlds(path, cell, rows[cell], board.spec.episodes)
    labels = [label_of(cell) for cell in cells]
    if list(submission.keys) != labels and set(submission.keys) != set(labels):
        raise ArtifactError(f"'{folder}': the keys are not those of the board's cells")
    sample = [label_of(cell) for cell in sample_of(cells, submission.files[ROWS])]
    if list(submission.sample) != sample:
        raise ArtifactError(
            f"'{folder}': the sample is not the one that its rows draw: {_few(sample)}"
        )
    return submission, {cell: rows[cell] for cell in cells}


def _check_worlds(path: Path, cell: CellIdentity, rows: pa.Table, episodes: int) -> None:
    """Raise an ArtifactError unless a cell has every episode of the board in its own world."""
    numbers = rows["episode"].to_pylist()
    if numbers != list(range(episodes)):
        raise ArtifactError(
            f"'{path}': {label_of(cell)} has {len(numbers)} episodes, and the board has {episodes}"
        )
    worlds = [seeds.layout_seed(cell.task, cell.seed, number) for number in numbers]
    if rows["episode_seed"].to_pylist() != worlds:
        raise ArtifactError(f"'{path}': {label_of(cell)} has episodes of other worlds")


def _few(labels: list[str]) -> str:
    shown = ", ".join(labels[:3])
    return f"{shown} and {len(labels) - 3} more" if len(labels) > 3 else shown
