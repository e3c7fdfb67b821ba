"""Sweeps over invented cells, with numbers that can be worked out by hand.

The n-th of N values adds n goals to what the operator alone reaches, intervenes in (n + 1) of ten
steps, and takes away n of N - 1 parts of the risk. The c-th operator reaches 4 - c goals in one
episode of a cell and 5 - c in the other; three are a success. An episode has 20 steps:

    return  goals + 2.375 in the first episode and goals + 2.625 in the second, so that a cell has 7
    - c + n cost    50 at risk 1 (c = 0, n = 0 and Human-only), 0 at risk 0 (the last value) mag_int
    |(0.375, 0.5)| = 0.625
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from tests.report.invented import invent, write
from tests.report.made import renamed
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import rows_of
from wasp_cli.metrics.episode import Trajectory
from wasp_cli.report.stats import Frame, read_frame
from wasp_cli.report.sweep import Swept
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity

VALUES: tuple[tuple[str, Any], ...] = (("0", 0), ("0.20", 0.2), ("0.6", 0.6))
"""As they are written, and as a file has them."""


def invent_sweep(folder: Path, missing: Sequence[CellIdentity] = ()) -> list[Swept]:
    """The cells of `human`, which no value changes, and of `diffusion`; the first value lacks
    those that are `missing`.
    """
    found = []
    for n, (text, value) in enumerate(VALUES):
        # A folder for each value: cells of one identity would have one key there.
        layout = Layout(folder / f"{n}")
        alone = written(layout, "human", 0, 0.0, 1.0)
        own = written(layout, "diffusion", n, (n + 1) / 10, 1 - n / (len(VALUES) - 1))
        for cell in own:
            if n == 0 and cell.identity in missing:
                rows_of(layout, cell).unlink()
        frame = read_frame(layout, [*alone, *own])
        found.append(Swept(text, value, keyed(frame, f"{n}" * 8)))
    return found


def keyed(frame: Frame, prefix: str, method: str = "diffusion") -> Frame:
    """The same with other keys of the cells of a method."""

    def key(cell: RecordedCell) -> dict[str, str]:
        return {"key": prefix + cell.key[len(prefix) :]} if cell.method == method else {}

    return replace(
        frame,
        cells=renamed(frame.cells, key),
        missing=tuple(
            replace(gap, cell=replace(gap.cell, **key(gap.cell))) for gap in frame.missing
        ),
        order=tuple(replace(cell, **key(cell)) for cell in frame.order),
    )


def written(
    layout: Layout, method: str, goals: int, intervene: float, risk: float
) -> list[RecordedCell]:
    """The cells of a method under two severities and with two seeds."""
    cells = []
    for (c, severity), seed in product(enumerate((0.2, 0.6)), (0, 1)):
        identity = CellIdentity("goal1", method, "full", "noisy", severity, seed)
        episodes = two_episodes(identity, 4 - c + goals, intervene, (1.0 - 0.1 * c) * risk)
        cells.append(write(layout, identity, episodes, success_goals=3))
    return cells


def two_episodes(
    identity: CellIdentity, goals: int, intervene: float, risk: float
) -> list[Trajectory]:
    """Two episodes that differ by one goal."""
    return [invent(12 * identity.seed + e, goals + e, intervene, risk) for e in range(2)]
