"""Noisy operator: with probability epsilon a uniform command replaces the intended one."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, Operator, OperatorContext


class NoisyOperator(Operator):
    """See the module; `epsilon` is the severity."""

    noise_size = 1
    draws_action = True
    epsilon: float

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator whose commands are replaced with the probability `value`."""
        operator = super().build(value, context, noise, batch)
        operator.epsilon = value
        return operator

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Replace the intended command by a uniform one at random."""
        slips = uniforms[:, :1] < self.epsilon
        return torch.where(slips, 2 * uniforms[:, 1:] - 1, intended), memory
