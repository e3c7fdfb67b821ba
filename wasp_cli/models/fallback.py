"""The fallback of a safety filter as a policy: what to do where nothing but safety counts. B rows,
F features, A actions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.nets import mlp

# bounds of the logarithm of the standard deviation, before the action is squashed
LEAST = -5.0
MOST = 1.0


class SafetyActor(nn.Module):
    """pi(a | h, z): a Gaussian squashed by tanh, the actor of SAC. It acts by its mean."""

    def __init__(self, features: int, action: int, hidden: Sequence[int]) -> None:
        """Build the actor, with hidden layers of these widths."""
        super().__init__()
        self.net = mlp(features, hidden, 2 * action)

    def forward(self, features: Tensor) -> Tensor:
        """Return the actions [B, A] in [-1, 1] that a filter falls back to."""
        mean, _ = self._gaussian(features)
        return mean.tanh()

    def sample(self, features: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions [B, A] for standard normal draws [B, A], and their log-densities [B]; both
        carry gradients.
        """
        mean, log_std = self._gaussian(features)
        raw = mean + log_std.exp() * normal
        density = -0.5 * normal.square() - log_std - 0.5 * math.log(2 * math.pi)
        # log(1 - tanh(x)^2) without the cancellation far from zero
        squashed = 2 * (math.log(2) - raw - F.softplus(-2 * raw))
        return raw.tanh(), (density - squashed).sum(-1)

    def _gaussian(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and the logarithm of the standard deviation, [B, A] each, before the
        action is squashed.
        """
        mean, spread = self.net(features).chunk(2, -1)
        share = (torch.tanh(spread) + 1) / 2
        return mean, LEAST + (MOST - LEAST) * share
