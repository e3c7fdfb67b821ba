"""Reactive operator: a stick that lags behind the hand, and a person who pushes back or lets go
when an assistant overrides them.

After the simulated pilots of Backman, Kulic and Chung, "Reinforcement learning for shared autonomy
drone landings" (Autonomous Robots 2023, arXiv 2202.02927). With V the intended command, a_h the
issued one and a the executed one, all [B, A], at each decision

    J   <- J + P (V - J)                        the stick follows the hand: P of the way
    a_h  = clip(J + GAIN * I, -1, 1)
    I   <- LEAK * I + (1 - alpha) (a_h - a)     what was overridden adds up, and is pushed against
    J   <- clip(J + alpha (a - a_h), -1, 1)     the hand yields towards what was executed

The stick, the integrator with its decay, and a conformance alpha from U[0, 1] for every episode are
the source's. These are not:

- The source has a goal estimate, which drifts by alpha (a - a_h). Here no goal is estimated, since
  V is the expert's command; the stick drifts instead, and comes back to V at its own pace.
- The phases of a landing, proficiency and speed are left out: the expert's policy takes their
  place.
- The severity is 1 - P; in the source P is proportional to an aggressiveness from U[0, 1].
- GAIN and LEAK are chosen here.

Without an assistant a is a_h: I stays zero, and the lag alone is left.
"""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, Operator, OperatorContext

# share of the integrator that is left after a decision. With it |I| <= 2 / (1 - LEAK), so that it
# cannot wind up.
LEAK = 0.9
GAIN = 0.05
"""Share of the integrator in the command. An operator of alpha = 0 that is held away from J by d
pushes back by d in the end: GAIN / (1 - LEAK - GAIN) = 1.
"""
UNDRAWN = -1.0  # alpha before the first decision


class ReactiveOperator(Operator):
    """See the module; the severity is the lag of the stick, 1 - P."""

    noise_size = 1
    lag: float

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator whose stick lags by `value`."""
        operator = super().build(value, context, noise, batch)
        operator.lag = value
        return operator

    def initial(self, batch: int) -> Memory:
        """Return a stick at rest, to which nothing was done yet: [B, A] each, and alpha [B, 1]."""
        nothing = torch.zeros(batch, self.action_size)
        # The first decision draws alpha, so that it comes from the episode's own stream and is the
        # same at every severity.
        return {
            "stick": nothing,
            "pushed": nothing.clone(),
            "issued": nothing.clone(),
            "alpha": torch.full((batch, 1), UNDRAWN),
        }

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Move the stick towards the intended command, and issue it with the push against what was
        overridden.
        """
        alpha = torch.where(memory["alpha"] == UNDRAWN, uniforms[:, :1], memory["alpha"])
        stick = memory["stick"] + (1 - self.lag) * (intended - memory["stick"])
        issued = (stick + GAIN * memory["pushed"]).clamp(-1, 1)
        return issued, {
            "stick": stick,
            "pushed": memory["pushed"],
            "issued": issued,
            "alpha": alpha,
        }

    def react(self, executed: Tensor, memory: Memory) -> Memory:
        """Add what was overridden to the push, and let the stick yield."""
        overridden = memory["issued"] - executed
        pushed = LEAK * memory["pushed"] + (1 - memory["alpha"]) * overridden
        return memory | {
            "pushed": pushed,
            "stick": (memory["stick"] - memory["alpha"] * overridden).clamp(-1, 1),
        }
