"""IDA with the least correction: of all actions with the force of its copilot's, the one
closest to the command.
"""

from __future__ import annotations

from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Parts
from wasp_cli.methods.ida import IDA
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator


class LeastIDA(IDA):
    """IDA, but the command stands where the copilot's action has the same force."""

    def __init__(self, config: Config, parts: Parts) -> None:
        super().__init__(config, parts)
        self.motors = parts.motors

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return IDA's decision on commands a_h [B, A], by the least actions of its force."""
        decision = super().decide(latent, a_h, operator)
        return decision._replace(action=self.motors.least(a_h, decision.action))
