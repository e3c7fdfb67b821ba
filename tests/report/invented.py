"""Cells with invented numbers, written through the real tables."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from tests.plans import plans_of, trajectory
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import NOTHING, rows_of
from wasp_cli.metrics.episode import Trajectory, episode_metrics
from wasp_cli.report.stats import Frame, read_frame, with_branches
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, Thresholds, write_cell
from wasp_cli.tasks.registry import TASKS

OPERATORS = {"noisy": (0.2, 0.6), "laggy": (0.5, 0.85)}
SKILL = {
    "human": (0, 0.0, 0.05),
    "ida": (2, 0.2, 0.04),
    "diffusion": (3, 1.0, 0.04),
    "saferl": (2, 1.0, 0.03),
    "wasp": (6, 0.25, 0.01),
}
"""method -> extra goals, share of steps intervened, share of steps with cost"""


def invent(start: int, goals: int, intervene: float, risk: float, steps: int = 20) -> Trajectory:
    """An episode of a made-up method. No random numbers, and multiples of 1/8: the same sums on
    every machine.
    """
    t = np.arange(steps) + start
    cost_env = np.where(t * 7 % 100 < 100 * risk, 1 + t % 4, 0)
    acts = t * 3 % steps < intervene * steps
    a_h = np.stack([t % 9 - 4, t * 5 % 7 - 3], 1) / 8
    won = (np.arange(steps) < goals).astype(int)
    a, plans = (
        np.where(acts[:, None], a_h + np.array([0.375, 0.5]), a_h),
        plans_of(np.where(acts, 0.5, np.nan), 30),
    )
    done = {"reward": won + t % 3 / 8, "cost": cost_env > 0, "cost_env": cost_env, "goals": won}
    return trajectory(steps, **done, a_h=a_h, a=a, gate=np.where(acts, 1, 0), plans=plans)


@dataclass
class Grid:
    """Cells in a results folder."""

    layout: Layout
    cells: list[RecordedCell]

    def rows(self, place: int) -> Path:
        """Where the rows of a cell are."""
        return rows_of(self.layout, self.cells[place])

    def of(self, holds: Callable[[RecordedCell], bool]) -> "Grid":
        """Some of the cells."""
        return Grid(self.layout, [cell for cell in self.cells if holds(cell)])

    def read(self, absent: Mapping[str, str] = NOTHING) -> Frame:
        """What a report reads of them."""
        return with_branches(self.layout, read_frame(self.layout, self.cells, absent), absent)


def key_of(identity: CellIdentity) -> str:
    return hashlib.sha256(repr(identity).encode()).hexdigest()[:20]


def write(
    layout: Layout, identity: CellIdentity, trajectories: list[Trajectory], success_goals: int = 7
) -> RecordedCell:
    """One cell in a results folder."""
    key = key_of(identity)
    folder = layout.artifact("evaluate", key)
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(folder, identity, trajectories, success_goals)
    severity = "severe" if identity.value in (0.6, 0.85) else "mild"
    return RecordedCell(**vars(identity), key=key, severity=severity)


def write_rows(
    folder: Path, identity: CellIdentity, trajectories: list[Trajectory], success_goals: int = 7
) -> Path:
    """The files of one cell in a folder; returns that of its episodes."""
    rows = [
        episode_metrics(trajectory, success_goals, 25.0, TASKS[identity.task].motors.force)
        for trajectory in trajectories
    ]
    times = [np.full(trajectory.steps, 2.0) for trajectory in trajectories]
    thresholds = (
        Thresholds(tau_c=0.3, tau_r=0.5 + identity.seed)
        if identity.method == "wasp"
        else Thresholds()
    )
    return write_cell(
        folder, identity, trajectories, rows, thresholds, times, [100 + i for i in range(len(rows))]
    )


def write_grid(
    folder: Path,
    seeds: tuple[int, ...] = (0, 1, 2),
    ablations: tuple[str, ...] = (),
    episodes: int = 4,
) -> Grid:
    """Methods x 2 operators x 2 severities x seeds, and the expert."""
    layout = Layout(folder)
    cells = []
    for method, variant in [
        *((name, "full") for name in SKILL),
        *(("wasp", name) for name in ablations),
    ]:
        goals, intervene, risk = SKILL[method]
        for (operator, value), seed in product(
            ((name, value) for name, values in OPERATORS.items() for value in values), seeds
        ):
            skill = 6 - int(6 * value) + goals - 2 * (variant != "full")
            trajectories = [
                invent(17 * seed + 5 * e, skill + (seed + e) % 3, intervene, 2 * risk)
                for e in range(episodes)
            ]
            identity = CellIdentity("goal1", method, variant, operator, value, seed)
            cells.append(write(layout, identity, trajectories))
    for seed in seeds:
        trajectories = [invent(17 * seed + 5 * e, 12, 0.0, 0.02) for e in range(episodes)]
        identity = CellIdentity("goal1", "expert", "full", "none", None, seed)
        cells.append(write(layout, identity, trajectories))
    return Grid(layout, cells)
