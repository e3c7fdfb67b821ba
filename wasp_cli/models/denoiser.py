"""The action denoiser of Diffusion (Yoneda et al. 2023): noise prediction conditioned on latent
features. B rows, F features, A actions, T diffusion steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class NoiseSchedule(nn.Module):
    """Sigmoid betas over T steps (logits -6..6) and what follows from them."""

    alpha_bar: Tensor  # [T] product of 1 - beta up to and with each step
    beta: Tensor  # [T]

    def __init__(self, steps: int, beta_min: float, beta_max: float) -> None:
        """Place T = `steps` betas between the two bounds."""
        super().__init__()
        shares = torch.linspace(-6, 6, steps, dtype=torch.float64).sigmoid()
        beta = shares * (beta_max - beta_min) + beta_min
        self.steps = steps
        self.register_buffer("beta", beta.float())
        self.register_buffer("alpha_bar", torch.cumprod(1 - beta, 0).float())

    def diffuse(self, action: Tensor, level: Tensor, noise: Tensor) -> Tensor:
        """Return x_k = sqrt(alpha_bar_k) a + sqrt(1 - alpha_bar_k) noise, [B, A], for actions
        [B, A] and levels k [B], which are indices.
        """
        alpha_bar = self.alpha_bar[level].unsqueeze(-1)
        return alpha_bar.sqrt() * action + (1 - alpha_bar).sqrt() * noise

    def forward_level(self, ratio: float) -> int:
        """Return k = floor((T - 1) ratio), the number of diffusion steps applied; 0 leaves the
        action alone.
        """
        return int((self.steps - 1) * ratio + 1e-9)


class Denoiser(nn.Module):
    """epsilon(x_k, k | h, z): softplus layers scaled by a learned embedding of the level."""

    def __init__(self, features: int, action: int, hidden: Sequence[int], steps: int) -> None:
        """Build layers of the widths `hidden`, for T = `steps` levels."""
        super().__init__()
        sizes = [features + action, *hidden]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.scales = nn.ModuleList(nn.Embedding(steps, b) for b in hidden)
        for scale in self.scales:
            nn.init.ones_(scale.weight)  # type: ignore[arg-type]
        self.outputs = nn.Linear(sizes[-1], action)

    def forward(self, features: Tensor, noisy: Tensor, level: Tensor) -> Tensor:
        """Predict the noise [B, A] in noisy actions [B, A] of levels [B] at features [B, F]."""
        x = torch.cat([features, noisy], -1)
        for layer, scale in zip(self.layers, self.scales, strict=True):
            x = F.softplus(layer(x)) * scale(level)
        return self.outputs(x)  # type: ignore[no-any-return]
