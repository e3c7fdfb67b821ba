"""What a decision leaves behind, for every method. B = episodes side by side, A = action size,
L = residual steps, I = iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.metrics.episode import GATE_NONE


class Record(NamedTuple):
    """One decision of B episodes; NaN where a field is undefined."""

    gate: Tensor  # int8 [B] one of GATE_* (`metrics.episode`)
    g_cost: Tensor  # [B] nominal cost return of the safety gate (Eq. 9)
    g_return: Tensor  # [B] nominal reward return (Eq. 10), on the same rollouts as `g_cost`
    delta_g: Tensor  # [B] gain of the task gate (Eq. 12)
    signal: Tensor  # [B] the method's own decision signal (IDA: ensemble vote)


class Planned(NamedTuple):
    """The residual plan of a decision, for B episodes; NaN (-1 in `safe`) in the rows where
    nothing was planned.
    """

    residuals: Tensor  # [B, L, A] the chosen sequence; its first element is executed (Eq. 18)
    safe: Tensor  # int16 [B, I] |F_s| (Eq. 14) of every iteration
    case2: Tensor  # bool [B, I] whether the iteration was in Case II
    cost: Tensor  # [B] predicted cost return of the chosen sequence
    reward: Tensor  # [B] its predicted reward return
    alone_cost: Tensor  # [B] predicted cost return of the commands alone, on the same rollouts
    alone_reward: Tensor  # [B] their predicted reward return

    @classmethod
    def nothing(
        cls,
        batch: int,
        iterations: int,
        steps: int,
        actions: int,
        device: torch.device | None = None,
    ) -> Planned:
        """Return a batch without a plan in any row.

        Args:
            batch: B.
            iterations: I.
            steps: L.
            actions: A.
            device: of the tensors; the CPU by default.
        """
        nan = torch.full((batch,), torch.nan, device=device)
        return cls(
            residuals=torch.full((batch, steps, actions), torch.nan, device=device),
            safe=torch.full((batch, iterations), -1, dtype=torch.int16, device=device),
            case2=torch.zeros(batch, iterations, dtype=torch.bool, device=device),
            cost=nan.clone(),
            reward=nan.clone(),
            alone_cost=nan.clone(),
            alone_reward=nan.clone(),
        )


def blank_record(batch: int, gate: int = GATE_NONE, device: torch.device | None = None) -> Record:
    """Return a record of `batch` decisions with one gate and every other field undefined (NaN)."""
    nan = torch.full((batch,), torch.nan, device=device)
    return Record(
        gate=torch.full((batch,), gate, dtype=torch.int8, device=device),
        g_cost=nan.clone(),
        g_return=nan.clone(),
        delta_g=nan.clone(),
        signal=nan.clone(),
    )


def chosen(mask: Tensor) -> Tensor:
    """Return the rows (indices [R]) to compute so that those of `mask` [B] (bool) are computed: on
    a CPU just these, on another device all of them.

    A CPU is faster by every row that is left out. Another device would have to wait until the
    number of rows is known, and could not replay the same work; there the caller masks what comes
    of the other rows.
    """
    if mask.device.type == "cpu":
        return mask.nonzero().flatten()
    return torch.arange(len(mask), device=mask.device)
