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
    """Split a loop into its episodes, without the decisions after their ends.

    Returns:
        A trajectory for each episode, and its decision times [T] in milliseconds.
    """
    # -- what the assistant recorded of its decisions; plans only where it always planned
    batch = loop.alive.shape[1]
    records = _stacked([decision.record or blank_record(batch) for decision in loop.decisions])
    planned = [decision.planned for decision in loop.decisions if decision.planned is not None]
    plans = _stacked(planned) if len(planned) == len(loop.decisions) else None

    # -- one episode after the other
    episodes: list[Trajectory] = []
    times: list[Array] = []
    for b in range(batch):
        rows = loop.alive[:, b].astype(bool)
        record_of_episode = {name: _finite(values[rows, b]) for name, values in records.items()}
        plans_of_episode: Plans | None = None
        if plans is not None:
            columns = {name: _finite(values[rows, b]) for name, values in plans.items()}
            plans_of_episode = Plans(**columns)
        episodes.append(
            Trajectory(
                reward=loop.reward[rows, b],
                cost=loop.cost[rows, b].astype(bool),
                cost_env=loop.cost_env[rows, b],
                env_steps=loop.env_steps[rows, b],
                goals=loop.goals[rows, b],
                a_h=loop.a_h[rows, b].astype(np.float64),
                a=loop.action[rows, b].astype(np.float64),
                **record_of_episode,
                plans=plans_of_episode,
            )
        )
        times.append(loop.decision_ms[rows])
    return episodes, times


def _stacked(decisions: list[Any] | list[Planned]) -> dict[str, Array]:
    """Return the fields of T decisions by name, each [T, B, ...]."""
    return {
        name: torch.stack([getattr(decision, name) for decision in decisions]).cpu().numpy()
        for name in decisions[0]._fields
    }


def _finite(values: Array) -> Array:
    """Return real numbers as float64, with infinities (no feasible candidate) as NaN; others as
    they are.
    """
    if not np.issubdtype(values.dtype, np.floating):
        return values
    wide = values.astype(np.float64)
    wide[~np.isfinite(wide)] = np.nan
    return wide
