"""Noisy operator, mode `burst`: random commands come in bursts, a Markov chain that is on or
off (after IDA's operators).
"""

from __future__ import annotations

import torch
from torch import Tensor

from wasp_cli.operators.base import Memory
from wasp_cli.operators.noisy import NoisyOperator

MEAN_BURST = 10.0  # decisions; IDA stops a burst with probability 0.1


class BurstNoiseOperator(NoisyOperator):
    """See the module; the severity `epsilon` is the share of the decisions within bursts, from
    the first decision of an episode on.
    """

    def initial(self, batch: int) -> Memory:
        """Return a memory [B, 1] outside of a burst, in which no decision was made yet."""
        return {
            "burst": torch.zeros(batch, 1, dtype=torch.bool),
            "started": torch.zeros(batch, 1, dtype=torch.bool),
        }

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Replace the intended command by a uniform one within a burst."""
        start, stop = burst_rates(self.epsilon)
        chance = uniforms[:, :1]
        burst = torch.where(memory["burst"], chance >= stop, chance < start)
        # At the first decision a burst is as likely as at any later one.
        burst = torch.where(memory["started"], burst, chance < self.epsilon)
        issued = torch.where(burst, 2 * uniforms[:, 1:] - 1, intended)
        return issued, {"burst": burst, "started": torch.ones_like(burst)}


def burst_rates(share: float) -> tuple[float, float]:
    """Return the probabilities per decision that a burst starts and that it stops, for a `share` of
    the decisions in bursts.

    Bursts last MEAN_BURST decisions on average, or longer where the share is so large that they
    would otherwise have to start with a probability above 1.
    """
    if share >= 1.0:
        return 1.0, 0.0
    stop = 1.0 / MEAN_BURST
    if share > 0.0:
        stop = min(stop, (1.0 - share) / share)
    start = stop * share / (1.0 - share)
    return start, stop
