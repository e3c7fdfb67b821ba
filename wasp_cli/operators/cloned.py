"""Cloned operator: commands drawn from a policy that was fitted to those of the real one, where
nobody knows its rule.
"""

from __future__ import annotations

import torch
from torch import Tensor

from wasp_cli.models.clone import Clone
from wasp_cli.operators.base import Memory, NoiseSource, Operator, Policy


class ClonedOperator(Operator):
    """See the module. All that it remembers is the last command, so that it can go on from any
    command of the real operator.
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
        return {"last": torch.full((batch, self.action_size), torch.nan)}

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Draw a^H [B, A] for what the operator sees now, [B, F]; memory and noise move on by
        one decision.
        """
        uniforms = self.noise.next(self.draws).to(features.device)
        issued = self.clone.sample(features, self.memory["last"], self.policy(features), uniforms)
        self.memory = {"last": issued}
        return issued
