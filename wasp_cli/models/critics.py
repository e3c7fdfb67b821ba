"""Value critics V_r and V_c on latent features (Eq. 7)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import mlp
from wasp_cli.models.two_hot import TwoHot


class LatentCritics(nn.Module):
    """Implements `models.base.Critics`. Both answer with a distribution over bins and start at zero."""

    def __init__(self, features: int, hidden: Sequence[int], bins: int = 63, reach: float = 1000.0) -> None:
        super().__init__()
        self.reward_net = mlp(features, hidden, bins, zero=True)
        self.cost_net = mlp(features, hidden, bins, zero=True)
        self.scale = TwoHot(bins, reach)

    def value_r(self, latent: Latent) -> Tensor:
        """[...] discounted reward from here on."""
        return self.scale.decode(self.reward_net(latent.features))

    def value_c(self, latent: Latent) -> Tensor:
        """[...] discounted costly decision steps from here on; never negative."""
        return self.scale.decode(self.cost_net(latent.features)).clamp(min=0)

    def losses(self, features: Tensor, target_r: Tensor, target_c: Tensor) -> tuple[Tensor, Tensor]:
        """Cross-entropies [...] of both critics at features [..., F] against their targets [...]."""
        return self.scale.loss(self.reward_net(features), target_r), self.scale.loss(self.cost_net(features), target_c)
