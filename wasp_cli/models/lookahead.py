"""A direct look ahead: from a latent and the next commands to the probability that anything costs within the next decisions.

Beside the world model's rolled-out costs it is a second witness, which has no step of imagination to go wrong. It is a hazard in discrete
time: each of H outputs is the probability of the first cost in decision k, given that none came before. So the answers for 5, 10 and 15
decisions never contradict each other, and an episode that a time limit cuts off counts for as long as it lasted.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from wasp_cli.models.ensemble import Ensemble


class LookAhead(Ensemble):
    """E hazards of features [B, F] and the next K commands [B, K, A]."""

    def __init__(
        self, members: int, features: int, action: int, commands: int, hidden: Sequence[int], horizon: int, dropout: float = 0.0
    ) -> None:
        super().__init__(members, features + commands * action, hidden, horizon, dropout)
        self.commands, self.horizon = commands, horizon

    def logits(self, features: Tensor, commands: Tensor) -> Tensor:
        """Return the logits [E, B, H] of the hazards; of commands [B, >= K, A] the first K are read."""
        return self.outputs(torch.cat([features, commands[:, : self.commands].flatten(1)], -1))

    def forward(self, features: Tensor, commands: Tensor) -> Tensor:
        """Return the probability [B, H] of any cost within the next 1..H decisions, this one included: the mean over the members."""
        return -torch.expm1(F.logsigmoid(-self.logits(features, commands)).cumsum(-1)).mean(0)

    def loss(self, features: Tensor, commands: Tensor, cost: Tensor, at_risk: Tensor) -> Tensor:
        """Return the negative log-likelihood [] per row, the mean over rows and members.

        Args:
            features: [B, F]
            commands: [B, K, A]
            cost: [B, H] in {0, 1}: the decision cost.
            at_risk: [B, H] in {0, 1}: nothing had cost before it, and what it cost is known.
        """
        logits = self.logits(features, commands)
        each = F.binary_cross_entropy_with_logits(logits, cost.expand_as(logits), reduction="none")
        return (each * at_risk).sum(-1).mean()
