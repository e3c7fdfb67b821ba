"""Halfway: where the command is far from the expert's action, the mean of the two is executed."""

import torch

from wasp_cli.methods.base import Decision
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD


class Halfway:
    """B episodes are decided side by side; A actions."""

    def __init__(self, config, parts):
        self.expert = parts.skills.expert

    def reset(self, rows, seeds):
        """Keep nothing between decisions."""

    def decide(self, latent, a_h, operator):
        expert = self.expert(latent.features).clamp(-1, 1)  # [B, A]
        distance = (expert - a_h).norm(dim=-1)  # [B]
        fired = distance > 0.7
        record = blank_record(len(a_h), device=a_h.device)._replace(
            gate=(GATE_METHOD * fired).to(torch.int8), signal=distance
        )
        return Decision(torch.where(fired.unsqueeze(-1), (a_h + expert) / 2, a_h), record)
