"""Noisy operator, mode `gaussian`: Gaussian noise is added to every intended command."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, Operator, OperatorContext


class GaussianNoiseOperator(Operator):
    """See the module; the severity is the standard deviation `sigma` in units of the command,
    which stays within its bounds.
    """

    draws_action = True
    sigma: float

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator of standard deviation `value`."""
        operator = super().build(value, context, noise, batch)
        operator.sigma = value
        return operator

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Add Gaussian noise to the intended command."""
        # Every source of noise offers uniforms, and 0 itself would become minus infinity.
        normals = torch.special.ndtri(uniforms.double().clamp(min=1e-12)).to(intended.dtype)
        return (intended + self.sigma * normals).clamp(-1, 1), memory
