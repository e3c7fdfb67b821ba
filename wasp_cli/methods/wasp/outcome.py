"""What a decision comes to: commands that stand until a plan is carried out.

B decisions, R of them with a plan, L residual steps, A actions, I iterations.
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
        """Return the second of N = 2 candidates as the plan, beside the command alone, which is the
        first.
        """
        batch = len(futures.reward)
        device = futures.reward.device
        safe = torch.full((batch, iterations), -1, dtype=torch.int16, device=device)
        return cls(
            residuals=futures.residuals[:, 1],
            cost=futures.cost[:, 1],
            reward=futures.reward[:, 1],
            alone_cost=futures.cost[:, 0],
            alone_reward=futures.reward[:, 0],
            safe=safe,
            case2=torch.zeros_like(safe, dtype=torch.bool),
        )


class Outcome:
    """What becomes of B commands: the actions, and the record and the plans behind them."""

    def __init__(self, a_h: Tensor, motors: Motors, iterations: int, steps: int) -> None:
        """Begin with commands a_h [B, A] that stand; `iterations` is I, `steps` is L."""
        self.a_h = a_h
        self.motors = motors
        self.action = a_h.clone()
        self.record = blank_record(len(a_h), device=a_h.device)
        self.planned = Planned.nothing(len(a_h), iterations, steps, a_h.shape[1], a_h.device)

    def saw(self, rows: Tensor, g_cost: Tensor, g_return: Tensor, delta_g: Tensor) -> None:
        """Note what the gates read [R] at some `rows` (indices [R])."""
        record = self.record
        record.g_cost[rows] = g_cost.to(record.g_cost.dtype)
        record.g_return[rows] = g_return.to(record.g_return.dtype)
        record.delta_g[rows] = delta_g.to(record.delta_g.dtype)

    def carry_out(self, rows: Tensor, fired: Tensor, gate: Tensor, plan: Plan) -> None:
        """Execute the first residual of plans (Eq. 18) by the least action of its force, and note
        them.

        Args:
            rows: decisions (indices [R]) that the plans are of.
            fired: bool [R] whether a gate fired there; the plans of the others count for nothing.
            gate: int8 [R] which one.
            plan: the plans.
        """

        def note(field: Tensor, value: Tensor) -> None:
            """Write `value` [R, ...] into `field` [B, ...] where a gate fired."""
            old = field[rows]
            mask = fired.view(-1, *([1] * (old.dim() - 1)))
            field[rows] = torch.where(mask, value, old).to(field.dtype)

        command = self.a_h[rows]
        corrected = (command + plan.residuals[:, 0]).clamp(-1, 1)
        note(self.action, self.motors.least(command, corrected))
        note(self.record.gate, gate)
        note(self.planned.residuals, plan.residuals)
        note(self.planned.safe, plan.safe)
        note(self.planned.case2, plan.case2)
        note(self.planned.cost, plan.cost)
        note(self.planned.reward, plan.reward)
        note(self.planned.alone_cost, plan.alone_cost)
        note(self.planned.alone_reward, plan.alone_reward)

    def decision(self) -> Decision:
        """Return what is decided."""
        return Decision(self.action, self.record, self.planned)


def refitted(plans: Tensor, is_elite: Tensor, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean and the standard deviation [B, L, A] of the elites among plans.

    Args:
        plans: [B, E, L, A].
        is_elite: bool [B, E].
        mean: [B, L, A] the mean of a decision without an elite.
        std: [B, L, A] its standard deviation.
    """
    weight = is_elite.to(plans.dtype).view(*is_elite.shape, 1, 1)
    count = weight.sum(1).clamp(min=1)  # [B, 1, 1]
    elite_mean = (weight * plans).sum(1) / count
    squares = (plans - elite_mean.unsqueeze(1)).square()
    elite_std = ((weight * squares).sum(1) / count).sqrt().clamp(min=STD_FLOOR)

    has_elites = is_elite.any(-1).view(-1, 1, 1)
    return torch.where(has_elites, elite_mean, mean), torch.where(has_elites, elite_std, std)
