"""The same assistants, with the least correction: of all actions of the force that they ask for, the one closest to the command."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Assistant, CalibratedAssistant, Decision, Heldout, Parts
from wasp_cli.methods.diffusion import Diffusion
from wasp_cli.methods.ida import IDA
from wasp_cli.methods.saferl import SafeRLRes
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.motors import Motors


class Least:
    """An assistant whose corrections leave the command where they do not change a motor's force."""

    def __init__(self, assistant: Assistant, motors: Motors) -> None:
        self.assistant, self.motors = assistant, motors

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.assistant.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        decision = self.assistant.decide(latent, a_h, operator)
        return decision._replace(action=self.motors.least(a_h, decision.action))


class LeastIDA(Least):
    """IDA; its threshold is its own."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.ida: CalibratedAssistant = IDA(config, parts)
        super().__init__(self.ida, parts.motors)

    def calibrate(self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int) -> dict[str, float]:
        """Calibrate IDA on K held-out decisions and their costs ahead [K]."""
        return self.ida.calibrate(heldout, cost_ahead, operator, seed)


def diffusion(config: Config, parts: Parts) -> Least:
    """Build Diffusion with the least correction."""
    return Least(Diffusion(config, parts), parts.motors)


def saferl(config: Config, parts: Parts) -> Least:
    """Build SafeRL-Res with the least correction."""
    return Least(SafeRLRes(config, parts), parts.motors)
