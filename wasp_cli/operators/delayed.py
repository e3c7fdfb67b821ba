"""Reaction-time operator: issues the command for what it saw d decisions ago. The first d commands
of an episode are neutral.
"""

from __future__ import annotations

import math
from typing import Self

import torch
from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, Operator, OperatorContext


class DelayedOperator(Operator):
    """See the module; the severity is the delay in seconds, rounded up to decision steps."""

    delay: int = 0  # d in decision steps

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator with a delay of `value` seconds."""
        operator = super().build(value, context, noise, batch)
        operator.delay = delay_steps(value, context.decision_seconds)
        operator.memory = operator.initial(batch)
        return operator

    def initial(self, batch: int) -> Memory:
        """Return a queue [B, d, A] of neutral commands."""
        return {"queue": torch.zeros(batch, self.delay, self.action_size)}

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Issue the oldest command of the queue, and append the intended one."""
        # [B, d + 1, A], oldest first
        queue = torch.cat([memory["queue"], intended.unsqueeze(1)], 1)
        return queue[:, 0], {"queue": queue[:, 1:]}


def delay_steps(seconds: float, decision_seconds: float) -> int:
    """Return the delay in whole decision steps, rounded up (0.24 s is 3 steps of 0.08 s and 2
    of 0.16 s).
    """
    return math.ceil(seconds / decision_seconds - 1e-9)
