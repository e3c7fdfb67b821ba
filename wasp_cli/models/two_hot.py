"""Real numbers as distributions over fixed bins, so that rare large values neither dominate a loss nor are averaged away.

A target is encoded by its two neighbouring bins (two-hot), trained with a cross-entropy, and read as the expectation over the bins in
linear space. The bins are spaced evenly in symlog(x) = sign(x) ln(1 + |x|): dense around zero, wide far away.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class TwoHot(nn.Module):
    """K bins from -reach to reach, zero among them. Holds no weights."""

    bins: Tensor
    """[K] rising, symmetric around zero"""

    def __init__(self, bins: int, reach: float) -> None:
        """Place the bins.

        Raises:
            ValueError: an even number of bins leaves none at zero, or fewer than three leave nothing beside it.
        """
        super().__init__()
        if bins < 3 or bins % 2 == 0:
            raise ValueError(f"{bins} bins: an odd number of at least 3 is needed")
        positive = torch.linspace(0.0, math.log1p(reach), bins // 2 + 1, dtype=torch.float64).expm1()[1:]
        whole = torch.cat([-positive.flip(0), positive.new_zeros(1), positive])
        # Constructor arguments define the bins; they are not stored with the weights.
        self.register_buffer("bins", whole.float(), persistent=False)

    def encode(self, value: Tensor) -> Tensor:
        """[...] to weights [..., K] whose expectation over the bins is the value; beyond the reach the last bin has all."""
        value = value.clamp(self.bins[0], self.bins[-1]).unsqueeze(-1)
        upper = torch.searchsorted(self.bins, value, right=True).clamp(1, len(self.bins) - 1)
        low, high = self.bins[upper - 1], self.bins[upper]
        share = (value - low) / (high - low)
        weights = torch.zeros(*value.shape[:-1], len(self.bins), dtype=value.dtype, device=value.device)
        return weights.scatter(-1, upper, share).scatter(-1, upper - 1, 1.0 - share)

    def decode(self, logits: Tensor) -> Tensor:
        """Expectation [...] of the distribution with these logits [..., K]; exactly zero for equal logits.

        Bins are summed in pairs of opposite sign: rounding of far bins would otherwise outweigh small values.
        """
        probs = logits.float().softmax(-1)
        half = len(self.bins) // 2
        difference = probs[..., half + 1 :] - probs[..., :half].flip(-1)
        return (difference * self.bins[half + 1 :]).sum(-1)

    def loss(self, logits: Tensor, value: Tensor) -> Tensor:
        """Cross-entropy [...] between logits [..., K] and the encoded value [...]."""
        return -(self.encode(value) * F.log_softmax(logits.float(), -1)).sum(-1)
