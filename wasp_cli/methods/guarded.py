"""IDA with WASP's safety gate behind it: the gate treats what IDA decides as if the operator had
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
    """See the module. The safety gate and its search are WASP's; IDA alone decides about the
    task.
    """

    def __init__(self, config: Config, parts: Parts) -> None:
        self.ida = IDA(config, parts)
        self.motors = parts.motors
        # Of the calibrated thresholds WASP's gate takes the one that follows from the task.
        settings = cast(GuardedIDAConfig, config).model_copy(update={"variant": "safety-only"})
        thresholds = {name: value for name, value in parts.thresholds.items() if name == "tau_c"}
        self.safety = wasp(settings, replace(parts, thresholds=thresholds))
        self.tau_q = self.ida.tau_q
        self.tau_c = self.safety.tau_c

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        self.ida.reset(rows, seeds)
        self.safety.reset(rows, seeds)

    def rest(self, rows: Tensor) -> None:
        """Decide nothing more in `rows` [B] (bool), whose episodes have ended."""
        self.safety.rest(rows)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A] after IDA and the safety gate; the signal is IDA's vote
        [B].
        """
        # IDA decides, by the least action of its force.
        by_ida = self.ida.decide(latent, a_h, operator)
        proposal = self.motors.least(a_h, by_ida.action)

        # The safety gate looks at that.
        by_gate = self.safety.decide(latent, proposal, operator)
        action = self.motors.least(a_h, by_gate.action)

        # Where both intervened, the record names the safety gate.
        assert by_ida.record is not None
        assert by_gate.record is not None
        gate = torch.where(by_gate.record.gate != 0, by_gate.record.gate, by_ida.record.gate)
        return Decision(action, by_gate.record._replace(gate=gate, signal=by_ida.record.signal))

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_Q as IDA does, from K held-out decisions and their costs ahead [K]; tau_c is a
        number of the configuration. Return both with IDA's distribution.
        """
        thresholds = self.ida.calibrate(heldout, cost_ahead, operator, seed)
        self.tau_q = self.ida.tau_q
        return thresholds | {"tau_c": self.tau_c}
