"""The lines of the leaderboard: assistants on tasks, from published rows or from submissions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from wasp_cli.errors import StoreError
from wasp_cli.leaderboard.board import Board, class_of
from wasp_cli.leaderboard.cells import label_of
from wasp_cli.leaderboard.check import checked
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.node import Node
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.bootstrap import Estimate, mean_of
from wasp_cli.report.stats import COLUMNS, CellNumbers, Wanted, pool_cells, read_frame
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.numbers import Numbers
from wasp_cli.store.published import Offer
from wasp_cli.store.tables import CellIdentity, Thresholds, cell_file

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
        asked = [node for cell, node in grid.cells if cell.method == method]
        offers: list[Offer] = []
        wanted: list[Wanted] = []
        for node in asked:
            reused = grid.reused.get(node.key)
            # A cut cell is not in the published folder under its key.
            if reused is None or reused.offer.episodes is not None:
                continue
            offers.append(reused.offer)
            wanted.append(_wanted(source, node, board))
        title = METHODS[method].title
        if not asked or len(wanted) < len(asked):
            partial.append(title)
            continue
        when = max(offer.started_at[:10] for offer in offers)
        versions = sorted({str(offer.manifest["provenance"]["wasp"]) for offer in offers})
        cells = _read(wanted)
        lines += _lines(cells, method, title, SHIPPED, when, versions[-1], None)
    return Shipped(tuple(lines), tuple(partial))


def _wanted(source: Layout, node: Node, board: Board) -> Wanted:
    """What is read of a published cell."""
    value = node.axes["value"]
    identity = CellIdentity(
        node.task,
        node.axes["method"],
        node.axes["method_config"].get("variant", "full"),
        node.axes["operator"],
        None if value is None else float(value),
        node.seed,
    )
    path = cell_file(source.artifact(KIND, node.key))
    chain = board.spec.chain_seed(node.seed)
    return Wanted(identity, node.label, path, chain_seed=chain)


def _read(wanted: Sequence[Wanted]) -> tuple[CellNumbers, ...]:
    """The numbers of cells. Raises StoreError where one cannot be read."""
    frame = read_frame(wanted)
    if frame.missing:
        gap = frame.missing[0]
        raise StoreError(f"{gap.label} cannot be read: {gap.reason}")
    return frame.cells


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
            (
                Wanted(cell, label_of(cell), folder, chain_seed=board.spec.chain_seed(cell.seed)),
                Numbers(cell, Thresholds(), table.select(COLUMNS)),
            )
            for cell, table in rows.items()
        ]
        cells = pool_cells(stored)
        lines += _lines(
            cells,
            submission.assistant,
            submission.title,
            submission.by,
            submission.when,
            submission.wasp,
            folder,
        )
    return lines


def _lines(
    cells: Sequence[CellNumbers],
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
    return [
        Line(
            task,
            title,
            by,
            when,
            version,
            folder,
            reference,
            _numbered([cell for cell in cells if cell.identity.task == task], attended=attended),
        )
        for task in dict.fromkeys(cell.identity.task for cell in cells)
    ]


def _numbered(cells: Sequence[CellNumbers], *, attended: bool) -> Numbered:
    return Numbered(
        _mean(cells, "return"),
        _mean(cells, "cost"),
        _mean(cells, "viol_env"),
        _mean(cells, "int_eff") if attended else None,
        _mean(cells, "int_rate") if attended else None,
    )


def _mean(cells: Sequence[CellNumbers], column: str) -> Estimate:
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
