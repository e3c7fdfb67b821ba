"""Draws from explicit generators, and imagined rollouts that use them. Evaluations may use this
file: nothing is trained here.
"""

from __future__ import annotations

import torch
from torch import Tensor

from wasp_cli.models.base import Latent, WorldModel


def generator(seed: int, device: str | torch.device = "cpu") -> torch.Generator:
    """Return a generator on a device that starts from a seed."""
    return torch.Generator(device).manual_seed(seed)


def gumbel(shape: tuple[int, ...], source: torch.Generator) -> Tensor:
    """Draw standard Gumbel variables of a shape on the generator's device."""
    uniform = torch.rand(shape, generator=source, device=source.device).clamp_(1e-20, 1 - 1e-7)
    return uniform.log_().neg_().log_().neg_()


def roll_prior(
    model: WorldModel, start: Latent, actions: Tensor, source: torch.Generator
) -> Latent:
    """Imagine H steps from B starts under given actions [B, H, A].

    Returns:
        The prior latents at which each step arrives, fields [B, H, .].
    """
    noise = gumbel((actions.shape[1], actions.shape[0], model.noise_size), source)
    hs, zs = [], []
    latent = start
    for k in range(actions.shape[1]):
        latent = model.imagine(latent, actions[:, k], noise[k])
        hs.append(latent.h)
        zs.append(latent.z)
    return Latent(torch.stack(hs, 1), torch.stack(zs, 1))
