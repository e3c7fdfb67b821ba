"""The contract of a world model.

Dimension letters: B batch rows (any leading shape works), A actions, D deterministic size, Z flat
stochastic size (S variables x C classes), F = D + Z features, N outputs of a network.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class Latent(NamedTuple):
    """The latent state: recurrent part h [..., D] and one-hot stochastic part z [..., Z]."""

    h: Tensor
    z: Tensor

    @property
    def features(self) -> Tensor:
        """Join h and z: [..., D + Z]."""
        return torch.cat([self.h, self.z], -1)

    def through(self, net: Callable[[Tensor], Tensor]) -> Tensor:
        """Return the outputs [..., N] of a network of features [..., F]."""
        return net(self.features)

    def to(self, device: torch.device) -> Latent:
        """Return the latent on another device."""
        return Latent(self.h.to(device), self.z.to(device))

    def rows(self, index: Tensor) -> Latent:
        """Return the rows [R, .] of some indices [R] along the first dimension."""
        return Latent(self.h[index], self.z[index])

    def expand_rows(self, copies: int) -> Latent:
        """Repeat [B, .] as [B * copies, .], the copies of a row adjacent."""
        return Latent(self.h.repeat_interleave(copies, 0), self.z.repeat_interleave(copies, 0))


class Dynamics(Protocol):
    """What an imagination asks of a world model: steps and heads, but no perception. Frozen at
    evaluation.
    """

    action_size: int
    noise_size: int  # Gumbel variables per imagined step and row

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        """Imagine one prior step for `action` [B, A]; `noise` [B, noise_size] are standard
        Gumbel draws.
        """
        ...

    def reward(self, latent: Latent) -> Tensor:
        """Return the mean reward [B] that the arrived state scores (Eq. 6, read at t+k+1 for
        a_{t+k}).
        """
        ...

    def cost(self, latent: Latent) -> Tensor:
        """Return the probability [B] of a cost event at the arrived state."""
        ...

    def continues(self, latent: Latent) -> Tensor:
        """Return the probability [B] that the episode has not ended at the arrived state."""
        ...


class WorldModel(Dynamics, Protocol):
    """What the closed loop asks of a world model: `Dynamics`, and perception."""

    @property
    def reads(self) -> str:
        """Which field of an observation it perceives (`tasks.base.Observation`): `pixels` or
        `state`.
        """
        ...

    def initial(self, batch: int) -> Latent:
        """Return the latent [B, .] before an episode."""
        ...

    def filter(self, latent: Latent, action: Tensor, seen: Tensor, first: Tensor) -> Latent:
        """Return the posterior after executing `action` [B, A] and seeing `seen` [B, ...]: pixels
        are uint8 [B, 6, 64, 64], states floats [B, S].

        Rows with `first` [B] start anew: h, z and the action are masked.
        """
        ...


class Critics(Protocol):
    """V_r and V_c (Eq. 7)."""

    def value_r(self, latent: Latent) -> Tensor:
        """Return the discounted reward [B] from a latent [B, .] on."""
        ...

    def value_c(self, latent: Latent) -> Tensor:
        """Return the discounted costly decisions [B] from a latent [B, .] on."""
        ...
