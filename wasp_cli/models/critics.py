"""Value critics V_r and V_c on latent features (Eq. 7), and Q_r and Q_c of actions, as
distributions over fixed bins.

Rare large values neither dominate the loss nor are averaged away: a target is encoded by its two
neighbouring bins (two-hot), trained with a cross-entropy, and read as the expectation over the bins
in linear space. The bins are spaced evenly in symlog(x) = sign(x) ln(1 + |x|): dense around zero,
wide far away. K bins, F features, A actions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import mlp


class TwoHot(nn.Module):
    """K bins from -reach to reach, zero among them. Holds no weights."""

    bins: Tensor  # [K] rising, symmetric around zero

    def __init__(self, bins: int, reach: float) -> None:
        """Place the bins, an odd number of at least 3.

        Raises:
            ValueError: the number of bins is another one.
        """
        super().__init__()
        if bins < 3 or bins % 2 == 0:
            raise ValueError(f"{bins} bins: an odd number of at least 3 is needed")
        positive = torch.linspace(
            0.0, math.log1p(reach), bins // 2 + 1, dtype=torch.float64
        ).expm1()[1:]
        whole = torch.cat([-positive.flip(0), positive.new_zeros(1), positive])
        # Constructor arguments define the bins; they are not stored with the weights.
        self.register_buffer("bins", whole.float(), persistent=False)

    def encode(self, value: Tensor) -> Tensor:
        """Return weights [..., K] of values [...] whose expectation over the bins is the value;
        beyond the reach the last bin has all.
        """
        value = value.clamp(self.bins[0], self.bins[-1]).unsqueeze(-1)
        upper = torch.searchsorted(self.bins, value, right=True).clamp(1, len(self.bins) - 1)
        low = self.bins[upper - 1]
        high = self.bins[upper]
        share = (value - low) / (high - low)  # of the upper bin
        weights = torch.zeros(
            *value.shape[:-1], len(self.bins), dtype=value.dtype, device=value.device
        )
        return weights.scatter(-1, upper, share).scatter(-1, upper - 1, 1.0 - share)

    def decode(self, logits: Tensor) -> Tensor:
        """Return the expectation [...] of the distribution with these logits [..., K]; exactly zero
        for equal logits.

        Bins are summed in pairs of opposite sign: rounding of far bins would otherwise outweigh
        small values.
        """
        probs = logits.float().softmax(-1)
        half = len(self.bins) // 2
        difference = probs[..., half + 1 :] - probs[..., :half].flip(-1)
        return (difference * self.bins[half + 1 :]).sum(-1)

    def loss(self, logits: Tensor, value: Tensor) -> Tensor:
        """Return the cross-entropy [...] between logits [..., K] and the encoded value [...]."""
        return -(self.encode(value) * F.log_softmax(logits.float(), -1)).sum(-1)


class LatentCritics(nn.Module):
    """V_r and V_c; implements `models.base.Critics`. Both answer with a distribution over bins and
    start at zero.
    """

    def __init__(
        self, features: int, hidden: Sequence[int], bins: int = 63, reach: float = 1000.0
    ) -> None:
        """Build both networks, with hidden layers of these widths and bins as in `TwoHot`."""
        super().__init__()
        self.reward_net = mlp(features, hidden, bins, zero=True)
        self.cost_net = mlp(features, hidden, bins, zero=True)
        self.scale = TwoHot(bins, reach)

    def value_r(self, latent: Latent) -> Tensor:
        """Return the discounted reward [...] from here on."""
        return self.scale.decode(latent.through(self.reward_net))

    def value_c(self, latent: Latent) -> Tensor:
        """Return the discounted costly decision steps [...] from here on; never negative."""
        return self.scale.decode(latent.through(self.cost_net)).clamp(min=0)

    def losses(self, features: Tensor, target_r: Tensor, target_c: Tensor) -> tuple[Tensor, Tensor]:
        """Return the cross-entropies [...] of both critics at features [..., F] against their
        targets [...].
        """
        loss_r = self.scale.loss(self.reward_net(features), target_r)
        loss_c = self.scale.loss(self.cost_net(features), target_c)
        return loss_r, loss_c


class ActionCritics(nn.Module):
    """Q_r and Q_c: the value of an action that is executed at a latent, with the expert afterwards.
    Both start at zero.
    """

    def __init__(
        self,
        features: int,
        action: int,
        hidden: Sequence[int],
        bins: int = 63,
        reach: float = 1000.0,
    ) -> None:
        """Build both networks, with hidden layers of these widths and bins as in `TwoHot`."""
        super().__init__()
        self.reward_net = mlp(features + action, hidden, bins, zero=True)
        self.cost_net = mlp(features + action, hidden, bins, zero=True)
        self.scale = TwoHot(bins, reach)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return Q_r and Q_c [2, ...] at features [..., F] and actions [..., A]; Q_c is never
        negative.
        """
        values = self.scale.decode(self._logits(features, action))
        return torch.stack([values[0], values[1].clamp(min=0)])

    def losses(self, features: Tensor, action: Tensor, target: Tensor) -> Tensor:
        """Return the cross-entropies [2, ...] of both critics against their targets [2, ...]."""
        return self.scale.loss(self._logits(features, action), target)

    def _logits(self, features: Tensor, action: Tensor) -> Tensor:
        inputs = torch.cat([features, action], -1)
        return torch.stack([self.reward_net(inputs), self.cost_net(inputs)])
