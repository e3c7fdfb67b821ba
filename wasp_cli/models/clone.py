"""A policy fitted to the recorded commands of one operator, whoever that is: a mixture of three
ways to come to a command.

The last command again, what the operator intends, or anything at all: laggy and noisy operators do
the first and the last with a fixed probability, and people hold on and slip too. Dimension letters:
B rows, F latent features, A actions.
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
        super().__init__()
        self.net = mlp(features + action, hidden, action, zero=True)
        # of repeating, of the own intention, of a uniform command
        self.weight_logits = nn.Parameter(torch.zeros(3))
        self.log_spread = nn.Parameter(torch.full((action,), math.log(0.2)))
        self.action = action

    def intended(self, features: Tensor, last: Tensor, nominal: Tensor) -> Tensor:
        """Return what the operator intends [B, A]: the nominal command [B, A] with a learned
        correction, which begins at zero.
        """
        wanted: Tensor = nominal + self.net(torch.cat([features, last.nan_to_num()], -1))
        return wanted.clamp(-1, 1)

    def log_weights(self, last: Tensor) -> Tensor:
        """Return the log-probabilities [B, 3] of repeating, of the own intention, and of a
        uniform command; at first nothing repeats.
        """
        repeat, *others = self.weight_logits
        first = last.isnan().any(-1)
        logits = [
            torch.where(first, -torch.inf, repeat),
            *(other.expand(len(last)) for other in others),
        ]
        return torch.stack(logits, -1).log_softmax(-1)

    @property
    def spread(self) -> Tensor:
        """[A] standard deviation around the intended command."""
        return self.log_spread.exp().clamp(*SPREAD)

    def log_density(
        self, command: Tensor, features: Tensor, last: Tensor, nominal: Tensor
    ) -> Tensor:
        """Return the log-density [B] of commands [B, A]."""
        parts = torch.stack(
            [
                _gaussian(command, last.nan_to_num(), torch.full_like(self.log_spread, REPEAT)),
                _gaussian(command, self.intended(features, last, nominal), self.spread),
                command.new_full((len(command),), -self.action * math.log(2.0)),
            ],
            -1,
        )
        return torch.logsumexp(parts + self.log_weights(last), -1)

    def mean(self, features: Tensor, last: Tensor, nominal: Tensor) -> Tensor:
        """Return the expected command [B, A]."""
        repeat, own, _ = self.log_weights(last).exp().unsqueeze(-1).unbind(1)
        return repeat * last.nan_to_num() + own * self.intended(features, last, nominal)

    def sample(self, features: Tensor, last: Tensor, nominal: Tensor, uniforms: Tensor) -> Tensor:
        """Draw commands [B, A] with uniforms [B, 1 + A]: one decides how the command comes
        about, the others what it is.
        """
        repeat, own, _ = self.log_weights(last).exp().unbind(-1)
        which, noise = uniforms[:, 0], uniforms[:, 1:]
        # Uniforms are what every source of noise offers; 0 itself would be minus infinity.
        normals = torch.special.ndtri(noise.double().clamp(min=1e-12)).to(features.dtype)
        intended = (self.intended(features, last, nominal) + self.spread * normals).clamp(-1, 1)
        drawn = torch.where((which < repeat + own).unsqueeze(-1), intended, 2 * noise - 1)
        return torch.where((which < repeat).unsqueeze(-1), last.nan_to_num(), drawn)


def _gaussian(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Log-density [B] at x [B, A] of independent normals of mean [B, A] and standard deviation
    [A].
    """
    return (-0.5 * ((x - mean) / std).square() - std.log() - 0.5 * math.log(2 * math.pi)).sum(-1)
