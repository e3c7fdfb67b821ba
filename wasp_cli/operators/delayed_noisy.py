"""Delayed and noisy operator: commands arrive late as under `reaction-time`, and some are
replaced by uniform ones as under `noisy`.
"""

from __future__ import annotations

from typing import Self

from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, OperatorContext
from wasp_cli.operators.delayed import DelayedOperator
from wasp_cli.operators.noisy import NoisyOperator

# seconds; the mild severity of `reaction-time`, so that neither impairment hides the other
DELAY = 0.16


class DelayedNoisyOperator(DelayedOperator):
    """See the module; the severity is the probability of a uniform action. A replaced command is
    lost, and delays none of the others.
    """

    noise_size = NoisyOperator.noise_size
    draws_action = NoisyOperator.draws_action
    noisy: NoisyOperator  # the rule of `noisy`, which remembers nothing

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator whose commands are replaced with the probability `value`."""
        operator = super().build(DELAY, context, noise, batch)
        operator.noisy = NoisyOperator.build(value, context, noise, batch)
        return operator

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Delay the intended command, then replace it at random."""
        late, memory = super().act(intended, memory, uniforms[:, :0])
        issued, _ = self.noisy.act(late, {}, uniforms)
        return issued, memory
