"""Careful: where a network expects cost of a command, the least risky of three actions is
executed instead.
"""

from __future__ import annotations

import torch

from wasp_cli.methods.base import Decision
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.weights import load_module
from wasp_example.risk import Risk


class Careful:
    """B episodes are decided side by side; F features of the filtered latent, A actions."""

    def __init__(self, config, parts):
        self.limit = config.limit
        # what the stage `risk` has left
        self.risk = load_module(Risk, parts.inputs["risk"] / "risk.safetensors").to(parts.device)
        self.expert = parts.skills.expert

    def reset(self, rows, seeds):
        """Keep nothing between decisions."""

    def decide(self, latent, a_h, operator):
        features = latent.features  # [B, F]
        # [B, 3, A]: command, expert, stop
        choices = torch.stack([a_h, self.expert(features), torch.zeros_like(a_h)], 1)
        risk = self.risk(features.unsqueeze(1).expand(-1, 3, -1), choices).sigmoid()  # [B, 3]
        fired = risk[:, 0] > self.limit  # [B]
        safest = choices[torch.arange(len(a_h)), risk.argmin(1)]  # [B, A]
        record = blank_record(len(a_h), device=a_h.device)._replace(
            gate=(GATE_METHOD * fired).to(torch.int8), signal=risk[:, 0]
        )
        return Decision(torch.where(fired.unsqueeze(-1), safest, a_h), record)
