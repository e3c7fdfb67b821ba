"""Cells of operators alone, with chosen returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.report.invented import invent, write_rows
from wasp_cli.plan.node import Cell
from wasp_cli.report.stats.frame import Wanted
from wasp_cli.store.tables import CellIdentity


def write_returns(folder: Path, cell: Cell, returns: Sequence[float]) -> Wanted:
    """A cell in `folder` as the store has it, with an episode for each return."""
    identity = CellIdentity(cell.task, cell.method, cell.assistant, cell.operator, cell.value, cell.seed)
    like = invent(0, 0, 0.0, 0.3)
    rewards = [np.eye(1, like.steps)[0] * value for value in returns]
    path = write_rows(folder, identity, [replace(like, reward=reward) for reward in rewards])
    return Wanted(identity, str(cell), path, cell.severity)
