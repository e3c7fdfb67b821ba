"""IDA (McMahan et al. 2024): the expert's action replaces the operator's when a Q ensemble votes for it.

The original votes over the possible goals; with one known goal that rule degenerates to sign(Q(a_c) - Q(a_h)), which fires almost
always. Here the members of an ensemble vote, with a margin tau_Q calibrated on the unimpaired expert.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import IDAConfig
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.ensemble import QEnsemble
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator


class IDA:
    """Copilot a_c: the expert's mean action. Intervene when mean_k sign(Q_k(a_c) - Q_k(a_h) - tau_Q) > vote."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(IDAConfig, config)
        self.ensemble = load_module(QEnsemble, parts.inputs["ida_q"] / "ensemble.safetensors")
        self.expert = parts.skills.expert
        self.tau_q = parts.thresholds.get("tau_q", 0.0)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Nothing is kept."""

    def advantage(self, features: Tensor, a_c: Tensor, a_h: Tensor) -> Tensor:
        """Q_k(a_c) - Q_k(a_h): [K, B]."""
        gain: Tensor = self.ensemble(features, a_c) - self.ensemble(features, a_h)
        return gain

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        features = latent.features
        a_c = self.expert(features)
        vote = (self.advantage(features, a_c, a_h) - self.tau_q).sign().mean(0)  # [B]
        intervene = vote > self.config.vote
        record = blank_record(len(a_h))._replace(signal=vote, gate=(GATE_METHOD * intervene).to(torch.int8))
        return Decision(torch.where(intervene.unsqueeze(-1), a_c, a_h), record)

    def calibrate(self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int) -> dict[str, float]:
        """tau_Q: a quantile of the least advantage over the members, which is what a full vote needs, under a noisy expert."""
        features = heldout.latent.features
        a_c = self.expert(features)
        noise = torch.from_numpy(np.random.default_rng(seed).standard_normal(tuple(a_c.shape), np.float32))
        a_h = (a_c + self.config.exploration * noise).clamp(-1, 1)
        margin = self.advantage(features, a_c, a_h).amin(0)
        return {"tau_q": float(torch.quantile(margin, self.config.quantile))}
