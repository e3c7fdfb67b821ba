"""From a recorded closed loop to the rows of a cell."""

from __future__ import annotations

import numpy as np
import torch

from wasp_cli.learning.closed_loop import Loop
from wasp_cli.metrics.episode import Trajectory


def trajectories(loop: Loop) -> tuple[list[Trajectory], list[np.ndarray]]:
    """One trajectory and the decision times [T] of each episode, without the rows after its end."""
    fields = {name: torch.stack([getattr(record, name) for record in loop.records]).numpy() for name in loop.records[0]._fields}
    found, times = [], []
    for b in range(loop.alive.shape[1]):
        rows = loop.alive[:, b].astype(bool)
        found.append(
            Trajectory(
                reward=loop.reward[rows, b], cost=loop.cost[rows, b].astype(bool), cost_env=loop.cost_env[rows, b],
                env_steps=loop.env_steps[rows, b], goals=loop.goals[rows, b],
                a_h=loop.a_h[rows, b].astype(np.float64), a=loop.action[rows, b].astype(np.float64),
                gate=fields["gate"][rows, b], g_cost=_float(fields["g_cost"][rows, b]), delta_g=_float(fields["delta_g"][rows, b]),
                signal=_float(fields["signal"][rows, b]), case2_share=_float(fields["case2_share"][rows, b]), safe=fields["safe"][rows, b],
            )
        )  # fmt: skip
        times.append(loop.decision_ms[rows])
    return found, times


def _float(values: np.ndarray) -> np.ndarray:
    """float64 with infinities (no feasible candidate) as undefined."""
    wide = values.astype(np.float64)
    wide[~np.isfinite(wide)] = np.nan
    return wide
