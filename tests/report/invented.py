"""Cells with invented numbers, written through the real tables."""

from itertools import product
from pathlib import Path

import numpy as np

from tests.plans import plans_of, trajectory
from wasp_cli.metrics.episode import Trajectory, episode_metrics
from wasp_cli.report.stats import Wanted
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


def write(
    folder: Path, identity: CellIdentity, trajectories: list[Trajectory], success_goals: int = 7
) -> Wanted:
    """One cell on disk, in a folder of its own."""
    name = "-".join(
        str(part)
        for part in (
            identity.method,
            identity.variant,
            identity.operator,
            identity.value,
            identity.seed,
        )
    )
    (folder / name).mkdir(parents=True, exist_ok=True)
    path = write_rows(folder / name, identity, trajectories, success_goals)
    return Wanted(
        identity,
        f"{identity.task} {name}",
        path,
        severity="severe" if identity.value in (0.6, 0.85) else "mild",
    )


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
) -> list[Wanted]:
    """Methods x 2 operators x 2 severities x seeds, and the expert."""
    wanted = []
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
            wanted.append(
                write(
                    folder,
                    CellIdentity("goal1", method, variant, operator, value, seed),
                    trajectories,
                )
            )
    for seed in seeds:
        trajectories = [invent(17 * seed + 5 * e, 12, 0.0, 0.02) for e in range(episodes)]
        wanted.append(
            write(folder, CellIdentity("goal1", "expert", "full", "none", None, seed), trajectories)
        )
    return wanted
