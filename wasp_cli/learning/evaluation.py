"""From a recorded closed loop to the rows of a cell."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.closed_loop import Loop
from wasp_cli.methods.record import Planned, blank_record
from wasp_cli.metrics.episode import Plans, Trajectory

Array = NDArray[Any]


def trajectories(loop: Loop) -> tuple[list[Trajectory], list[Array]]:
    """Return one trajectory and the decision times [T] in milliseconds of each episode, without
    the rows after its end.
    """
    batch = loop.alive.shape[1]
    records = _stacked([decision.record or blank_record(batch) for decision in loop.decisions])
    planned = [decision.planned for decision in loop.decisions if decision.planned is not None]
    plans = _stacked(planned) if len(planned) == len(loop.decisions) else None
    found, times = [], []
    for b in range(batch):
        rows = loop.alive[:, b].astype(bool)
        found.append(
            Trajectory(
                reward=loop.reward[rows, b],
                cost=loop.cost[rows, b].astype(bool),
                cost_env=loop.cost_env[rows, b],
                env_steps=loop.env_steps[rows, b],
                goals=loop.goals[rows, b],
                a_h=loop.a_h[rows, b].astype(np.float64),
                a=loop.action[rows, b].astype(np.float64),
                **{name: _finite(values[rows, b]) for name, values in records.items()},
                plans=None
                if plans is None
                else Plans(**{name: _finite(values[rows, b]) for name, values in plans.items()}),
            )
        )
        times.append(loop.decision_ms[rows])
    return found, times


def _stacked(decisions: list[Any] | list[Planned]) -> dict[str, Array]:
    """The fields of T decisions, each [T, B, ...]."""
    return {
        name: torch.stack([getattr(decision, name) for decision in decisions]).cpu().numpy()
        for name in decisions[0]._fields
    }


def _finite(values: Array) -> Array:
    """Real numbers as float64, with infinities (no feasible candidate) as undefined."""
    if not np.issubdtype(values.dtype, np.floating):
        return values
    wide = values.astype(np.float64)
    wide[~np.isfinite(wide)] = np.nan
    return wide
