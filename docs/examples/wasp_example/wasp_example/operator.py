"""Sluggish: a hand that is slow to change. The issued command is a mean of the intended one and
the last.
"""

from __future__ import annotations

import torch

from wasp_cli.operators.base import Operator


class SluggishOperator(Operator):
    """The severity is the weight of the last issued command; the first command of an episode is
    as intended.
    """

    @classmethod
    def build(cls, value, context, noise, batch):
        operator = super().build(value, context, noise, batch)
        operator.weight = value
        return operator

    def initial(self, batch):
        return {
            "last": torch.zeros(batch, self.action_size),
            "started": torch.zeros(batch, 1, dtype=torch.bool),
        }

    def act(self, intended, memory, uniforms):
        blended = (1 - self.weight) * intended + self.weight * memory["last"]
        issued = torch.where(memory["started"], blended, intended)  # [B, A]
        return issued, {"last": issued, "started": torch.ones_like(memory["started"])}
