"""Value critics V_r and V_c on latent features (Eq. 7)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import mlp


class LatentCritics(nn.Module):
    """Implements `models.base.Critics`. Both start at zero."""

    def __init__(self, features: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.reward_net = mlp(features, hidden, 1, zero=True)
        self.cost_net = mlp(features, hidden, 1, zero=True)

    def value_r(self, latent: Latent) -> Tensor:
        """[...] discounted reward from here on."""
        return self.reward_net(latent.features).squeeze(-1)  # type: ignore[no-any-return]

    def value_c(self, latent: Latent) -> Tensor:
        """[...] discounted costly decision steps from here on; never negative."""
        return self.cost_net(latent.features).squeeze(-1).clamp(min=0)  # type: ignore[no-any-return]
