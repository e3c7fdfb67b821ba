"""IDA (McMahan et al. 2024): a copilot's action replaces the operator's when a Q ensemble votes for
it.

The original votes over the possible goals; with one known goal that rule degenerates to sign(Q(a_c)
- Q(a_h)), which fires almost always. Here the members of an ensemble vote, with a margin tau_Q
calibrated on the unimpaired expert. The copilot is the expert's mean action, as the paper has it,
or the original's: the command, partly diffused and denoised.
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
from wasp_cli.methods.diffusion import Assist, load_assist
from wasp_cli.methods.noise import DecisionNoise
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.ensemble import QEnsemble
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator
from wasp_cli.seeds import derive


class IDA:
    """Intervene with a_c when mean_k sign(Q_k(a_c) - Q_k(a_h) - tau_Q) > vote."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(IDAConfig, config)
        self.ensemble = load_module(QEnsemble, parts.inputs["ida_q"] / "ensemble.safetensors").to(
            parts.device
        )
        self.expert = parts.skills.expert
        self.diffusion: Assist | None = None
        if self.config.copilot == "diffusion":
            self.diffusion = load_assist(
                parts.inputs["denoiser"], self.config.ratio, device=parts.device
            )
        self.tau_q = parts.thresholds.get("tau_q", 0.0)
        self.noise = DecisionNoise(parts.device)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)

    def advantage(self, features: Tensor, a_c: Tensor, a_h: Tensor) -> Tensor:
        """Return Q_k(a_c) - Q_k(a_h), [K, B], at features [B, F] for actions [B, A]."""
        gain: Tensor = self.ensemble(features, a_c) - self.ensemble(features, a_h)
        return gain

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        features = latent.features
        a_c = self._copilot(features, a_h, self.noise)
        vote = (self.advantage(features, a_c, a_h) - self.tau_q).sign().mean(0)  # [B]
        intervene = vote > self.config.vote
        record = blank_record(len(a_h), device=a_h.device)._replace(
            signal=vote, gate=(GATE_METHOD * intervene).to(torch.int8)
        )
        return Decision(torch.where(intervene.unsqueeze(-1), a_c, a_h), record)

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_Q to a quantile of the margin [N] at which the vote tips, over commands of the
        expert with exploration noise.

        A copilot that draws may propose something else than the expert to the expert itself: there
        the quantile is at least that of the expert without noise.
        """
        features = heldout.latent.features
        expert = self.expert(features)
        noise = torch.from_numpy(
            np.random.default_rng(seed).standard_normal(tuple(expert.shape), np.float32)
        ).to(expert.device)
        a_h = (expert + self.config.exploration * noise).clamp(-1, 1)
        copilots = DecisionNoise(self.noise.device)
        copilots.reset(
            torch.ones(len(a_h), dtype=torch.bool),
            [derive("ida-copilot", seed, i) for i in range(len(a_h))],
        )
        margin = self._tips(self.advantage(features, self._copilot(features, a_h, copilots), a_h))
        # Without noise the expert is what the copilot of that name proposes, and nothing can be
        # gained.
        own = self._tips(
            self.advantage(features, self._copilot(features, expert, copilots), expert)
        )
        self.tau_q = max(
            float(torch.quantile(values, self.config.quantile)) for values in (margin, own)
        )
        spread = {
            f"margin_{label}": float(torch.quantile(margin, q))
            for label, q in (("median", 0.5), ("p90", 0.9), ("p95", 0.95))
        }
        return {
            "tau_q": self.tau_q,
            **spread,
            "expert_rate": float((own > self.tau_q).float().mean()),
        }

    def _tips(self, advantage: Tensor) -> Tensor:
        """Return the largest tau_Q [B] below which the members' advantages [K, B] win the vote."""
        members = len(advantage)
        needed = next(
            (n for n in range(1, members) if (2 * n - members) / members > self.config.vote),
            members,
        )
        return advantage.sort(0, descending=True).values[needed - 1]

    def _copilot(self, features: Tensor, a_h: Tensor, noise: DecisionNoise) -> Tensor:
        """Return a_c [B, A]."""
        proposed: Tensor = (
            self.expert(features)
            if self.diffusion is None
            else self.diffusion(features, a_h, noise.streams())
        )
        return proposed
