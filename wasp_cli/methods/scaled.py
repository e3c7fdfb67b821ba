"""An assistant whose corrections are scaled: a share, or a multiple, of them is executed."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from wasp_cli.methods.base import Assistant, Decision
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator


class Scaled:
    """a = clip(a^H + share (a' - a^H)), where a' is the action of the assistant."""

    def __init__(self, assistant: Assistant, share: float) -> None:
        """Scale the corrections of `assistant` by `share`, 0 or more."""
        self.assistant = assistant
        self.share = share

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool)."""
        self.assistant.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the decision of the assistant with its correction scaled, [B, A]."""
        decision = self.assistant.decide(latent, a_h, operator)
        action = (a_h + self.share * (decision.action - a_h)).clamp(-1, 1)
        return decision._replace(action=action)
