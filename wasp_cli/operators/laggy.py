"""Laggy operator: with probability p the last issued command is repeated; the first of an
episode is fresh.
"""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, Operator, OperatorContext


class LaggyOperator(Operator):
    """See the module; `p` is the severity. The *issued* command is repeated, not what an
    assistant executed.
    """

    noise_size = 1
    p: float

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator that repeats with the probability `value`."""
        operator = super().build(value, context, noise, batch)
        operator.p = value
        return operator

    def initial(self, batch: int) -> Memory:
        """Return a memory of B rows in which no command was issued yet."""
        return {
            "last": torch.zeros(batch, self.action_size),
            "started": torch.zeros(batch, 1, dtype=torch.bool),
        }

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Repeat the last issued command at random, or issue the intended one."""
        repeats = (uniforms[:, :1] < self.p) & memory["started"]
        issued = torch.where(repeats, memory["last"], intended)
        return issued, {"last": issued, "started": torch.ones_like(memory["started"])}
