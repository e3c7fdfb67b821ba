"""Consistency model of expert actions: one network evaluation takes a noisy action to the end of
its probability flow.

Levels of noise are standard deviations sigma, from SIGMA_MIN to SIGMA_MAX (Karras et al. 2022);
f(x, SIGMA_MIN) = x (Song et al. 2023). The teacher, a diffusion model on the same levels, has the
same form. B rows, F features, A actions.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Constants of Karras et al. 2022, and of every configuration in the code of CSA.
SIGMA_MIN = 0.002  # smallest level
SIGMA_MAX = 80.0  # largest level
RHO = 7.0  # how the levels between lie: the larger, the more small ones
SIGMA_DATA = 0.5  # standard deviation of clean actions
FREQUENCIES = 8  # of the embedding of a level


def sigma_at(ratio: float) -> float:
    """Return the level at a share of the ladder: SIGMA_MIN at 0, SIGMA_MAX at 1, sigma^(1 /
    RHO) linear between (Karras et al., Eq. 5).
    """
    if ratio <= 0:
        return SIGMA_MIN
    least = SIGMA_MIN ** (1 / RHO)
    most = SIGMA_MAX ** (1 / RHO)
    return float((least + ratio * (most - least)) ** RHO)


def ladder(levels: int) -> Tensor:
    """Return a number of levels [levels], at least two, falling from SIGMA_MAX to SIGMA_MIN."""
    return torch.tensor([sigma_at(1 - i / (levels - 1)) for i in range(levels)])


class Consistency(nn.Module):
    """f(x, sigma | h, z) = c_skip x + c_out F(c_in x, sigma | h, z). It is a consistency model, or
    as its teacher the mean of the clean action.

    F adds an embedding of the level and of the features to every layer, as the code of CSA does.
    """

    frequencies: Tensor

    def __init__(self, features: int, action: int, width: int, depth: int) -> None:
        """Build F with `depth` layers of `width` units."""
        super().__init__()
        self.register_buffer("frequencies", 2.0 ** torch.arange(FREQUENCIES) / 4, persistent=False)
        self.level = nn.Sequential(
            nn.Linear(2 * FREQUENCIES, width), nn.SiLU(), nn.Linear(width, width)
        )
        self.context = nn.Sequential(nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width))
        self.layers = nn.ModuleList(nn.Linear(width if i else action, width) for i in range(depth))
        self.outputs = nn.Linear(width, action)

    def forward(self, features: Tensor, noisy: Tensor, sigma: Tensor) -> Tensor:
        """Return clean actions [B, A] for noisy ones [B, A] of levels [B] at features [B, F]."""
        return self.within(self.context(features), noisy, sigma)

    def within(self, context: Tensor, noisy: Tensor, sigma: Tensor) -> Tensor:
        """Return what `forward` returns, from the embedding `context(features)` [B, width], which
        then serves several levels at the same features.
        """
        phases = sigma.log().unsqueeze(-1) * self.frequencies
        embedding = context + self.level(torch.cat([phases.sin(), phases.cos()], -1))
        sigma = sigma.unsqueeze(-1)
        scale = (sigma.square() + SIGMA_DATA**2).rsqrt()
        x = scale * noisy
        for layer in self.layers:
            x = F.silu(layer(x) + embedding)
        # Offset by SIGMA_MIN, so that the boundary condition is exact: c_skip is 1 and c_out 0
        # there (Song et al. 2023, appendix C).
        above = sigma - SIGMA_MIN
        skip = SIGMA_DATA**2 / (above.square() + SIGMA_DATA**2)
        return skip * noisy + above * SIGMA_DATA * scale * self.outputs(x)  # type: ignore[no-any-return]
