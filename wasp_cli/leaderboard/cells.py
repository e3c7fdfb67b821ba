"""The cells of a board: their labels, their nodes, and which ones `wasp verify` computes again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wasp_cli.plan.grid import Grid
from wasp_cli.plan.node import Node, cell_label
from wasp_cli.store.tables import CellIdentity


def label_of(cell: CellIdentity) -> str:
    """Return a cell's label as a run prints it."""
    who = cell_label(cell.method, cell.variant, cell.operator, cell.value)
    return f"{cell.task} s{cell.seed} {who}"


def sample_of(cells: Sequence[CellIdentity], digest: str) -> list[CellIdentity]:
    """Return a cell of each task, drawn by the SHA-256 of the rows: other rows have another
    sample.
    """
    draws = np.random.default_rng(int(digest, 16))
    by_task: dict[str, list[CellIdentity]] = {}
    for cell in cells:
        by_task.setdefault(cell.task, []).append(cell)
    return [each[int(draws.integers(len(each)))] for each in by_task.values()]


def drawn(cells: Sequence[CellIdentity], count: int, seed: int) -> list[CellIdentity]:
    """Return `count` cells, or all where there are fewer, drawn by a seed; in their order."""
    draws = np.random.default_rng(seed)
    places = draws.choice(len(cells), min(count, len(cells)), replace=False)
    return [cells[place] for place in sorted(places)]


def nodes_of(grid: Grid) -> dict[CellIdentity, Node]:
    """Return the nodes of a grid by their cells."""
    return {
        CellIdentity(
            cell.task, cell.method, cell.variant, cell.operator, _number(cell.value), cell.seed
        ): node
        for cell, node in grid.cells
    }


def _number(value: float | str | None) -> float | None:
    return None if value is None else float(value)
