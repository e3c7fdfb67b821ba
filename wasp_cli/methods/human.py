"""Human-only and Expert: the operator's command is executed as it is."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Parts
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator


class HumanOnly:
    """No assistance."""

    def __init__(self, config: Config | None = None, parts: Parts | None = None) -> None:
        """Read nothing."""

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Keep nothing of the rows [B]."""

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A] as they are."""
        return Decision(a_h)
