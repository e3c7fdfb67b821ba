"""IDA with WASP's safety gate behind it: what it decides is looked at as if the operator had
commanded it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import GuardedIDAConfig
from wasp_cli.methods.ida import IDA
from wasp_cli.methods.wasp.assistant import wasp
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator


class GuardedIDA:
    """See the module. The safety gate and its search are those of WASP; the task is IDA's."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.ida, self.motors = IDA(config, parts), parts.motors
        safety = cast(GuardedIDAConfig, config).model_copy(update={"variant": "safety-only"})
        # Of the calibrated thresholds WASP's gate takes the one that follows from the task.
        found = {name: value for name, value in parts.thresholds.items() if name == "tau_c"}
        self.safety = wasp(safety, replace(parts, thresholds=found))
        self.tau_q, self.tau_c = self.ida.tau_q, self.safety.tau_c

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.ida.reset(rows, seeds)
        self.safety.reset(rows, seeds)

    def rest(self, rows: Tensor) -> None:
        """Decide nothing more in `rows` [B] (bool), whose episodes have ended."""
        self.safety.rest(rows)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        first = self.ida.decide(latent, a_h, operator)
        chosen = self.motors.least(a_h, first.action)
        second = self.safety.decide(latent, chosen, operator)
        assert first.record is not None
        assert second.record is not None
        gate = torch.where(second.record.gate != 0, second.record.gate, first.record.gate)
        record = second.record._replace(gate=gate, signal=first.record.signal)
        return Decision(self.motors.least(a_h, second.action), record)

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_Q as IDA does, from K held-out decisions and their costs ahead [K]; tau_c is
        a number.
        """
        found = self.ida.calibrate(heldout, cost_ahead, operator, seed)
        self.tau_q = self.ida.tau_q
        return found | {"tau_c": self.tau_c}
