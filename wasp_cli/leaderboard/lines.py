"""The lines of the leaderboard: assistants on tasks, from published rows or from submissions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wasp_cli.cells.cell import RecordedCell, recorded_cell
from wasp_cli.cells.read import read_cells, table_of
from wasp_cli.cells.rows import CellRows
from wasp_cli.cells.table import COLUMNS, CellTable
from wasp_cli.errors import StoreError
from wasp_cli.leaderboard.board import Board, class_of
from wasp_cli.leaderboard.check import checked
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.bootstrap import Estimate, mean_of
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import Offer
from wasp_cli.store.tables import CellIdentity, Thresholds

SHIPPED = "wasp"
"""Who submits the assistants that come with the package."""


@dataclass(frozen=True)
class Numbered:
    """What an assistant came to on a task: means over the board's cells with 95 % intervals over
    its worlds.
    """

    returned: Estimate  # of an episode
    cost: Estimate  # of an episode
    cost_rate: Estimate  # per env step
    effective: Estimate | None  # effective intervention rate; None where nobody commands
    intervened: Estimate | None  # intervention rate


@dataclass(frozen=True)
class Line:
    """An assistant on a task."""

    task: str
    title: str
    by: str
    when: str
    wasp: str  # the version that computed it
    folder: Path | None  # of the submission; None of what comes with the package
    reference: bool  # whether it assists nobody, and is in no class
    numbers: Numbered

    @property
    def bound(self) -> float | None:
        """The bound of its class; None of a reference."""
        if self.reference or self.numbers.effective is None:
            return None
        return class_of(self.numbers.effective.value)


@dataclass(frozen=True)
class Shipped:
    """The lines of the assistants that come with the package."""

    lines: tuple[Line, ...]
    partial: tuple[str, ...]  # titles of those that have only a part of the board's cells


def shipped_lines(board: Board) -> Shipped:
    """Return the lines of the published rows of a board's spec."""
    source = Layout(board.published)
    grid = lay_out_over(board.spec, Layout(Path("nowhere")), str(board.published))
    lines: list[Line] = []
    partial: list[str] = []
    for method in board.spec.methods:
        asked = [(cell, node) for cell, node in grid.cells if cell.method == method]
        offers: list[Offer] = []
        there: list[RecordedCell] = []
        for cell, node in asked:
            reused = grid.reused.get(node.key)
            # A cut cell is not in the published folder under its key.
            if reused is None or reused.offer.episodes is not None:
                continue
            offers.append(reused.offer)
            there.append(
                recorded_cell(
                    source,
                    cell,
                    node.key,
                    board.spec.name,
                    training_seed=board.spec.training_seed,
                )
            )
        title = METHODS[method].title
        if not asked or len(there) < len(asked):
            partial.append(title)
            continue
        when = max(offer.started_at[:10] for offer in offers)
        versions = sorted({str(offer.manifest["provenance"]["wasp"]) for offer in offers})
        cells = _read(source, there)
        lines += _lines(cells, method, title, SHIPPED, when, versions[-1], None)
    return Shipped(tuple(lines), tuple(partial))


def _read(source: Layout, cells: Sequence[RecordedCell]) -> CellTable:
    """The rows of cells. Raises StoreError where those of one cannot be read."""
    found = read_cells(source, cells)
    if found.missing:
        gap = found.missing[0]
        raise StoreError(f"{gap.label} cannot be read: {gap.reason}")
    return found.table


def submitted_lines(folders: Iterable[Path], board: Board) -> list[Line]:
    """Return the lines of submissions.

    Raises:
        UsageError: a folder holds no submission.
        ArtifactError, StoreError: a submission was changed or is not complete.
    """
    lines: list[Line] = []
    for folder in folders:
        submission, rows = checked(folder, board)
        stored = [
            CellRows(_submitted_cell(cell, board), Thresholds(), table.select(COLUMNS))
            for cell, table in rows.items()
        ]
        lines += _lines(
            table_of(stored),
            submission.assistant,
            submission.title,
            submission.by,
            submission.when,
            submission.wasp,
            folder,
        )
    return lines


def _submitted_cell(cell: CellIdentity, board: Board) -> RecordedCell:
    """A cell of a submission, whose rows are in no store."""
    return RecordedCell(
        cell.task,
        cell.method,
        cell.variant,
        cell.operator,
        cell.value,
        cell.seed,
        spec=board.spec.name,
        training_seed=board.spec.training_seed,
    )


def _lines(
    cells: CellTable,
    method: str,
    title: str,
    by: str,
    when: str,
    version: str,
    folder: Path | None,
) -> list[Line]:
    """A line for each task that cells are of."""
    # What a submission names may not be installed here, and assists somebody.
    info = METHODS[method] if method in METHODS.own else None
    reference = info is not None and not info.impaired
    attended = info is None or info.attended
    tasks = np.array([cell.task for cell in cells])
    lines = []
    for task in dict.fromkeys(cell.task for cell in cells):
        numbers = _numbered(cells.choose(tasks == task), attended=attended)
        lines.append(Line(task, title, by, when, version, folder, reference, numbers))
    return lines


def _numbered(cells: CellTable, *, attended: bool) -> Numbered:
    return Numbered(
        _mean(cells, "return"),
        _mean(cells, "cost"),
        _mean(cells, "viol_env"),
        _mean(cells, "int_eff") if attended else None,
        _mean(cells, "int_rate") if attended else None,
    )


def _mean(cells: CellTable, column: str) -> Estimate:
    estimate = mean_of(cells, column)
    if estimate is None:
        raise StoreError(f"no row has a number in '{column}'")
    return estimate


def ahead(line: Line, others: Iterable[Line]) -> bool:
    """Return whether nobody in the same class, or in one that intervenes less, returns as much and
    costs as little, and is better in one of the two. Means are compared as they are.
    """
    bound = line.bound
    if bound is None:
        return False
    for other in others:
        if other is line or other.task != line.task or other.bound is None or other.bound > bound:
            continue
        returned = other.numbers.returned.value - line.numbers.returned.value
        saved = line.numbers.cost.value - other.numbers.cost.value
        if min(returned, saved) >= 0 and max(returned, saved) > 0:
            return False
    return True
