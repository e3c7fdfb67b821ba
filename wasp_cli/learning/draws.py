"""Random draws for training loops, from explicit generators."""

from __future__ import annotations

import torch
from torch import Tensor


def generator(seed: int, device: str | torch.device = "cpu") -> torch.Generator:
    """A seeded generator."""
    return torch.Generator(device).manual_seed(seed)


def gumbel(shape: tuple[int, ...], source: torch.Generator) -> Tensor:
    """Standard Gumbel draws on the generator's device."""
    uniform = torch.rand(shape, generator=source, device=source.device).clamp(1e-20, 1 - 1e-7)
    return -(-uniform.log()).log()
