"""A policy fitted to the recorded commands of one operator, simulated or not: a mixture of three
ways to come to a command.

The operator repeats the last command, issues what it intends, or issues anything at all. Laggy
operators do the first and noisy ones the last with a fixed probability, and people hold on and slip
too. Dimension letters: B rows, F latent features, A actions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from wasp_cli.models.nets import mlp

# standard deviation around the last command within which a command counts as the same
REPEAT = 0.02
SPREAD = (0.02, 1.0)
"""Bounds of the standard deviation around the intended command: below the first a density says
nothing about commands.
"""


class Clone(nn.Module):
    """p(command | features, last command): features [B, F], commands [B, A] in [-1, 1]. `last`
    is NaN before the first command.
    """

    def __init__(self, features: int, hidden: Sequence[int], action: int) -> None:
        """Build a clone that intends the nominal command: F features, A actions, and the widths
        of the network's layers.
        """
        super().__init__()
        self.net = mlp(features + action, hidden, action, zero=True)
        # logits of repeating, of the intended command, and of a uniform one
        self.weight_logits = nn.Parameter(torch.zeros(3))
        self.log_spread = nn.Parameter(torch.full((action,), math.log(0.2)))
        self.action = action

    def intended(self, features: Tensor, last: Tensor, nominal: Tensor) -> Tensor:
        """Return what the operator intends [B, A]: the nominal command [B, A] with a learned
        correction, which begins at zero.
        """
        correction: Tensor = self.net(torch.cat([features, last.nan_to_num()], -1))
        return (nominal + correction).clamp(-1, 1)

    def log_weights(self, last: Tensor) -> Tensor:
        """Return the log-probabilities [B, 3] of repeating, of the intended command, and of a
        uniform one; the first command of an episode repeats nothing.
        """
        repeat, intended, uniform = self.weight_logits
        first = last.isnan().any(-1)
        logits = [
            torch.where(first, -torch.inf, repeat),
            intended.expand(len(last)),
            uniform.expand(len(last)),
        ]
        return torch.stack(logits, -1).log_softmax(-1)

    @property
    def spread(self) -> Tensor:
        """Return the standard deviation [A] around the intended command."""
        return self.log_spread.exp().clamp(*SPREAD)

    def log_density(
        self, command: Tensor, features: Tensor, last: Tensor, nominal: Tensor
    ) -> Tensor:
        """Return the log-density [B] of commands [B, A] at features [B, F], after the last
        commands [B, A], where the nominal policy commands [B, A].
        """
        repeat = torch.full_like(self.log_spread, REPEAT)
        repeated = _gaussian(command, last.nan_to_num(), repeat)
        intended = _gaussian(command, self.intended(features, last, nominal), self.spread)
        uniform = command.new_full((len(command),), -self.action * math.log(2.0))
        parts = torch.stack([repeated, intended, uniform], -1)  # [B, 3]
        return torch.logsumexp(parts + self.log_weights(last), -1)

    def mean(self, features: Tensor, last: Tensor, nominal: Tensor) -> Tensor:
        """Return the expected command [B, A]; arguments as in `log_density`."""
        repeat, intended, _ = self.log_weights(last).exp().unsqueeze(-1).unbind(1)
        return repeat * last.nan_to_num() + intended * self.intended(features, last, nominal)

    def sample(self, features: Tensor, last: Tensor, nominal: Tensor, uniforms: Tensor) -> Tensor:
        """Draw commands [B, A] with uniforms [B, 1 + A]: the first one decides how the command
        comes about, the others what it is. Other arguments as in `log_density`.
        """
        repeat, intended, _ = self.log_weights(last).exp().unbind(-1)
        which = uniforms[:, 0]
        noise = uniforms[:, 1:]

        # The intended command with its spread. Every source of noise offers uniforms, and 0 itself
        # would become minus infinity.
        normals = torch.special.ndtri(noise.double().clamp(min=1e-12)).to(features.dtype)
        mean = self.intended(features, last, nominal)
        own_command = (mean + self.spread * normals).clamp(-1, 1)

        uniform_command = 2 * noise - 1
        is_repeated = (which < repeat).unsqueeze(-1)
        is_own = (which < repeat + intended).unsqueeze(-1)
        fresh = torch.where(is_own, own_command, uniform_command)
        return torch.where(is_repeated, last.nan_to_num(), fresh)


def _gaussian(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return the log-density [B] at x [B, A] of independent normals of mean [B, A] and standard
    deviation [A].
    """
    return (-0.5 * ((x - mean) / std).square() - std.log() - 0.5 * math.log(2 * math.pi)).sum(-1)
