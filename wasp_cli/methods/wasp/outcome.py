"""What a decision of WASP comes to while it is made: commands that stand until a plan is carried out. B decisions, L residual steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.record import Planned, Record, blank_record
from wasp_cli.methods.wasp.planner import Plan


@dataclass
class Outcome:
    """Of B decisions, whichever of them are corrected."""

    a_h: Tensor
    """[B, A] the commands"""
    action: Tensor
    """[B, A] to be executed"""
    plan: Tensor
    """[B, L, A] carried out; zeros where none is"""
    warm: Tensor
    """bool [B] one is"""
    recovering: Tensor
    """bool [B] it is no safe one, but the safest there was"""
    planned: Planned
    record: Record

    @classmethod
    def standing(cls, a_h: Tensor, config: WASPConfig) -> Outcome:
        """Begin with commands a_h [B, A] that stand."""
        batch, actions = a_h.shape
        nothing = torch.zeros(batch, dtype=torch.bool, device=a_h.device)
        plan = torch.zeros(batch, config.residual_steps, actions, device=a_h.device)
        planned = Planned.nothing(batch, config.iterations, config.residual_steps, actions, a_h.device)
        return cls(a_h, a_h.clone(), plan, nothing, nothing.clone(), planned, blank_record(batch, device=a_h.device))

    def carry_out(self, rows: Tensor, gated: Tensor, gate: Tensor | int, made: Plan) -> None:
        """Execute the first residual of plans (Eq. 18), and note them.

        Args:
            rows: decisions (indices [R]) that the plans are of.
            gated: bool [R] whether a gate fired there; the plans of the others count for nothing.
            gate: which one, int8 [R] or one for all.
            made: the plans.
        """

        def note(field: Tensor, value: Tensor | float) -> None:
            kept = field[rows]
            mask = gated.view(-1, *([1] * (kept.dim() - 1)))
            field[rows] = torch.where(mask, value, kept).to(field.dtype)

        note(self.action, (self.a_h[rows] + made.residuals[:, 0]).clamp(-1, 1))
        note(self.record.gate, gate)
        note(self.plan, made.residuals)
        note(self.warm, True)
        note(self.recovering, ~made.found_safe)
        found = (
            made.residuals, made.safe, made.case2, made.predicted.cost, made.predicted.reward, made.alone.cost, made.alone.reward,
        )  # fmt: skip
        for field, value in zip(self.planned, found, strict=True):
            note(field, value)

    def among(self, rows: Tensor, a_h: Tensor, config: WASPConfig) -> Outcome:
        """Return the same among all commands a_h [C, A], of which these are some `rows` (indices [B]); the others stand."""
        whole = Outcome.standing(a_h, config)
        every = (whole.action, whole.plan, whole.warm, whole.recovering, *whole.planned, *whole.record)
        own = (self.action, self.plan, self.warm, self.recovering, *self.planned, *self.record)
        for field, value in zip(every, own, strict=True):
            field[rows] = value.to(field.dtype)
        return whole
