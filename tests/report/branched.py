"""Invented counterfactual branches beside invented cells, written through the real tables."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.report.invented import Grid, key_of
from wasp_cli.methods.registry import METHODS
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.store.branches import BRANCHES_FILE, BranchedCell, BranchRow, write_branches
from wasp_cli.store.tables import CellIdentity, read_episodes, read_steps

WINDOW, TAU_R = 4, 0.25
WORTH = {"ida": 2, "diffusion": 5, "saferl": 4, "wasp": 1}
"""The larger, the fewer interventions avoid a cost."""


def with_invented_branches(grid: Grid, stride: int = 1) -> Grid:
    """The cells of methods that intervene with branches at every `stride`-th intervention. No
    random numbers, and multiples of 1/8.
    """
    cells = list(grid.cells)
    for place, cell in enumerate(cells):
        if METHODS[cell.method].intervenes:
            key = key_of(cell.identity)[::-1]
            folder = grid.layout.artifact("counterfactual", key)
            invent_branches(grid.rows(place), cell.identity, folder, stride)
            cells[place] = replace(cell, branches=key)
    return Grid(grid.layout, cells)


def invent_branches(cell: Path, identity: CellIdentity, folder: Path, stride: int = 1) -> Path:
    """The table of branches of the cell at `cell`, in a new folder."""
    steps = [step for step in read_steps(cell).to_pylist() if step["deviation"] > 0][::stride]
    rows: list[BranchRow] = []
    for number, step in enumerate(steps):
        length = WINDOW - (number % 11 == 10)
        helped = number % WORTH[identity.method] == 0
        costs = np.arange(length) < (number + identity.seed) % 3 + helped
        gained = (number % 5) / 8
        for name, cost, reward in ((ASSISTED, costs & (not helped), gained), (ALONE, costs, 0.25)):
            values = (
                step["episode"],
                step["t"],
                name,
                cost,
                2 * cost,
                np.full(length, reward),
                step["deviation"],
                step["gate"],
            )
            rows.append(BranchRow(*values))
    folder.mkdir(parents=True)
    write_branches(
        folder / BRANCHES_FILE,
        BranchedCell(identity, WINDOW, stride, TAU_R, read_episodes([cell]).num_rows),
        rows,
    )
    return folder / BRANCHES_FILE
