"""CSA (Sun et al. 2025): the command is treated as a noisy action of the expert and denoised in one
step, without a draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Parts
from wasp_cli.methods.configs import CSAConfig
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.consistency import Consistency, sigma_at
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator


class CSA:
    """a = f(a_h, sigma | h, z), where sigma is at `ratio` of the ladder of levels; at 0 the command
    stands bit for bit.
    """

    def __init__(self, config: Config, parts: Parts) -> None:
        self.ratio = cast(CSAConfig, config).ratio
        path = parts.inputs["consistency"] / "consistency.safetensors"
        self.model = load_module(Consistency, path).to(parts.device)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Keep nothing of the rows [B]: nothing is drawn."""

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A], denoised."""
        if self.ratio == 0:
            return Decision(a_h)
        sigma = torch.full((len(a_h),), sigma_at(self.ratio), device=a_h.device)
        action = self.model(latent.features, a_h, sigma).clamp(-1, 1)
        return Decision(action, blank_record(len(a_h), GATE_METHOD, a_h.device))
