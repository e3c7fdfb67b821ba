"""Cloned operator: its commands are drawn from a policy that was fitted to those of the real one,
whose rule is unknown.
"""

from __future__ import annotations

import torch
from torch import Tensor

from wasp_cli.models.clone import Clone
from wasp_cli.operators.base import Memory, NoiseSource, Operator, Policy


class ClonedOperator(Operator):
    """See the module. It remembers the last command alone, so that it can go on from any command of
    the real operator.
    """

    noise_size = 1
    draws_action = True

    def __init__(
        self, clone: Clone, nominal: Policy, action_size: int, noise: NoiseSource, batch: int
    ) -> None:
        """Begin B = `batch` episodes; `nominal` is the policy that the clone corrects."""
        self.clone = clone
        super().__init__(nominal, action_size, noise, batch)

    def initial(self, batch: int) -> Memory:
        """Return a memory [B, A] without a last command: NaN."""
        return {"last": torch.full((batch, self.action_size), torch.nan)}

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return a^H [B, A], drawn for what the operator sees now, [B, F]; memory and noise move on
        by one decision.
        """
        uniforms = self.noise.next(self.draws).to(features.device)
        issued = self.clone.sample(features, self.memory["last"], self.policy(features), uniforms)
        self.memory = {"last": issued}
        return issued
