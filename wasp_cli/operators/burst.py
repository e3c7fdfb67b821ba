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
        return {
            "burst": torch.zeros(batch, 1, dtype=torch.bool),
            "started": torch.zeros(batch, 1, dtype=torch.bool),
        }

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        start, stop = burst_rates(self.epsilon)
        on = torch.where(memory["burst"], uniforms[:, :1] >= stop, uniforms[:, :1] < start)
        # an episode begins as it goes on
        on = torch.where(memory["started"], on, uniforms[:, :1] < self.epsilon)
        return torch.where(on, 2 * uniforms[:, 1:] - 1, intended), {
            "burst": on,
            "started": torch.ones_like(on),
        }


def burst_rates(share: float) -> tuple[float, float]:
    """Return the probabilities per decision that a burst starts and that it stops, for a `share` of
    the decisions in bursts.

    Bursts last MEAN_BURST decisions on average, longer where so large a share leaves no room
    between them.
    """
    if share >= 1.0:
        return 1.0, 0.0
    stop = min(1.0 / MEAN_BURST, (1.0 - share) / share) if share > 0.0 else 1.0 / MEAN_BURST
    return stop * share / (1.0 - share), stop
