"""A filter without a world model: h is the observation, z is empty, and nothing can be imagined. It
serves assistants that imagine nothing.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from wasp_cli.models.base import Latent


class StateWorld:
    """The filter of a task whose state is perceived whole. S = size of the state, A = action
    size.
    """

    reads: ClassVar[str] = "state"

    def __init__(self, state_size: int, action_size: int) -> None:
        """Serve states of S numbers and actions of A numbers."""
        self.state_size = state_size
        self.action_size = action_size

    def initial(self, batch: int) -> Latent:
        """Return the latent [B, S] before anything has been seen: zeros."""
        return latent_of(torch.zeros(batch, self.state_size))

    def filter(self, latent: Latent, action: Tensor, seen: Tensor, first: Tensor) -> Latent:
        """Return the latent of the state `seen` [B, S]; the other arguments are not read."""
        return latent_of(seen)


def latent_of(state: Tensor) -> Latent:
    """Return states [..., S] as latents: h [..., S] in single precision, z [..., 0]."""
    h = state.to(torch.float32)
    return Latent(h, h.new_zeros(*h.shape[:-1], 0))
