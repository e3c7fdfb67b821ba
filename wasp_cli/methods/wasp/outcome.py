"""What a decision comes to: commands that stand until a plan is carried out. B decisions, L
residual steps, I iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.methods.base import Decision
from wasp_cli.methods.record import Planned, blank_record
from wasp_cli.methods.wasp.imagine import Scored
from wasp_cli.tasks.motors import Motors

STD_FLOOR = 0.05  # least spread of what a search samples: keeps its distribution from collapsing


class Plan(NamedTuple):
    """The selected residual sequences of R decisions, and how the search went."""

    residuals: Tensor  # [R, L, A]
    cost: Tensor  # [R] predicted cost return
    reward: Tensor  # [R] predicted reward return
    alone_cost: Tensor  # [R] of the command without a correction, on the same rollouts
    alone_reward: Tensor  # [R]
    # [R, I] |F_s| of every iteration (Eq. 14); CUT_OFF for those that were left out, -1 where
    # nothing was searched
    safe: Tensor
    case2: Tensor  # [R, I] whether it was fewer than N_f

    @classmethod
    def unsearched(cls, futures: Scored, iterations: int) -> Plan:
        """Return the second of N = 2 candidates as the plan, beside the command alone, the
        first.
        """
        (alone, best), (cost_alone, cost) = futures.reward.unbind(1), futures.cost.unbind(1)
        none = torch.full((len(best), iterations), -1, dtype=torch.int16, device=best.device)
        return cls(futures.residuals[:, 1], cost, best, cost_alone, alone, none, none >= 0)


class Outcome:
    """Of B decisions, whichever of them are corrected."""

    def __init__(self, a_h: Tensor, motors: Motors, iterations: int, steps: int) -> None:
        """Begin with commands a_h [B, A] that stand."""
        self.a_h, self.motors, self.action = a_h, motors, a_h.clone()
        self.record = blank_record(len(a_h), device=a_h.device)
        self.planned = Planned.nothing(len(a_h), iterations, steps, a_h.shape[1], a_h.device)

    def saw(self, rows: Tensor, g_cost: Tensor, g_return: Tensor, delta_g: Tensor) -> None:
        """Note what the gates read [R] at some `rows` (indices [R])."""
        for field, value in zip(
            (self.record.g_cost, self.record.g_return, self.record.delta_g),
            (g_cost, g_return, delta_g),
            strict=True,
        ):
            field[rows] = value.to(field.dtype)

    def carry_out(self, rows: Tensor, gated: Tensor, gate: Tensor, made: Plan) -> None:
        """Execute the first residual of plans (Eq. 18) by the least action of its force, and note
        them.

        Args:
            rows: decisions (indices [R]) that the plans are of.
            gated: bool [R] whether a gate fired there; the plans of the others count for nothing.
            gate: int8 [R] which one.
            made: the plans.
        """

        def note(field: Tensor, value: Tensor) -> None:
            kept = field[rows]
            field[rows] = torch.where(gated.view(-1, *([1] * (kept.dim() - 1))), value, kept).to(
                field.dtype
            )

        command = self.a_h[rows]
        note(self.action, self.motors.least(command, (command + made.residuals[:, 0]).clamp(-1, 1)))
        note(self.record.gate, gate)
        found = (
            made.residuals,
            made.safe,
            made.case2,
            made.cost,
            made.reward,
            made.alone_cost,
            made.alone_reward,
        )
        for field, value in zip(self.planned, found, strict=True):
            note(field, value)

    def decision(self) -> Decision:
        """Return what is decided."""
        return Decision(self.action, self.record, self.planned)


def refitted(plans: Tensor, elite: Tensor, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation [B, L, A] of those of the plans [B, E, L, A] that are
    elites [B, E]; of none: as they were.
    """
    weight = elite.to(plans.dtype).view(*elite.shape, 1, 1)
    total, some = weight.sum(1).clamp(min=1), elite.any(-1).view(-1, 1, 1)
    centre = (weight * plans).sum(1) / total
    spread = (
        ((weight * (plans - centre.unsqueeze(1)).square()).sum(1) / total)
        .sqrt()
        .clamp(min=STD_FLOOR)
    )
    return torch.where(some, centre, mean), torch.where(some, spread, std)
