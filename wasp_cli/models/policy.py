"""Policies: the expert's actor on privileged observations, and latent actors on (h, z)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from wasp_cli.models.nets import mlp


class PrivilegedPolicy(nn.Module):
    """The mean action of a PPO actor (tanh layers) on normalised privileged observations, clipped to the action box."""

    mean: Tensor
    std: Tensor
    log_std: Tensor

    def __init__(self, inputs: int, hidden: Sequence[int], action: int) -> None:
        super().__init__()
        sizes = [inputs, *hidden]
        layers: list[nn.Module] = []
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.Tanh()]
        self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], action))
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        self.register_buffer("log_std", torch.zeros(action))

    def forward(self, privileged: Tensor) -> Tensor:
        """[B, P] to [B, A] in [-1, 1]."""
        return self.net(((privileged - self.mean) / self.std).clamp(-10, 10)).clamp(-1, 1)  # type: ignore[no-any-return]


class LatentPolicy(nn.Module):
    """pi(a | h, z): features [B, F] to a command [B, A] in [-1, 1]."""

    def __init__(self, features: int, hidden: Sequence[int], action: int) -> None:
        super().__init__()
        self.net = mlp(features, hidden, action)

    def forward(self, features: Tensor) -> Tensor:
        return self.net(features).clamp(-1, 1)  # type: ignore[no-any-return]

    def unbounded(self, features: Tensor) -> Tensor:
        """The output before the bounds, for a loss whose gradient does not vanish at them."""
        return self.net(features)  # type: ignore[no-any-return]


class Skills(nn.Module):
    """One latent policy per expert checkpoint, by its fraction of the interactions ('0.25', '1')."""

    def __init__(self, fractions: Sequence[float], features: int, hidden: Sequence[int], action: int) -> None:
        super().__init__()
        self.fractions = tuple(fractions)
        self.actors = nn.ModuleList(LatentPolicy(features, hidden, action) for _ in fractions)
        self.register_buffer("exploration", torch.zeros(action))

    exploration: Tensor
    """[A] standard deviation of the expert's own exploration when training ended."""

    @property
    def expert(self) -> LatentPolicy:
        return self.at(1.0)

    def at(self, fraction: float) -> LatentPolicy:
        """The policy of a checkpoint.

        Raises:
            KeyError: there is no checkpoint at that fraction.
        """
        for known, actor in zip(self.fractions, self.actors, strict=True):
            if abs(known - fraction) < 1e-9:
                assert isinstance(actor, LatentPolicy)
                return actor
        raise KeyError(f"no checkpoint at {fraction:g}; there are {', '.join(f'{f:g}' for f in self.fractions)}")
