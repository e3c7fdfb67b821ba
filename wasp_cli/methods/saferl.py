"""SafeRL-Res (after Schaff and Walter 2020): the mean of a residual policy over (h, z, a^H) is
added to every command.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Parts
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.residual import ResidualPolicy
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator


class SafeRLRes:
    """a = clip(a^H + delta(h, z, a^H))."""

    def __init__(self, config: Config, parts: Parts) -> None:
        path = parts.inputs["residual"] / "residual.safetensors"
        self.policy = load_module(ResidualPolicy, path).to(parts.device)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Keep nothing of the rows [B]: nothing is drawn."""

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A] with the policy's correction, within the bounds."""
        action = (a_h + self.policy(latent.features, a_h)).clamp(-1, 1)
        return Decision(action, blank_record(len(a_h), GATE_METHOD, a_h.device))
