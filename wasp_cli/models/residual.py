"""The residual policy of SafeRL-Res: the actor of a stable-baselines3 PPO as a plain module."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn


class ResidualPolicy(nn.Module):
    """The mean residual delta(h, z, a^H), of F features and A actions."""

    def __init__(self, features: int, action: int, hidden: Sequence[int]) -> None:
        """Build the policy, with tanh layers of these widths; it starts at zero."""
        super().__init__()
        sizes = [features + action, *hidden]
        layers: list[nn.Module] = []
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.Tanh()]
        self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], action))
        nn.init.zeros_(self.net[-1].weight)  # type: ignore[arg-type]
        nn.init.zeros_(self.net[-1].bias)  # type: ignore[arg-type]

    def forward(self, features: Tensor, a_h: Tensor) -> Tensor:
        """Return residuals [B, A] in [-2, 2] for commands [B, A] at features [B, F]."""
        residual: Tensor = self.net(torch.cat([features, a_h], -1))
        return residual.clamp(-2, 2)
