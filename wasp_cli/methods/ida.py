"""IDA (McMahan et al. 2024): a copilot's action replaces the operator's when a Q ensemble votes for
it.

The original votes over the possible goals; with one known goal that rule degenerates to
sign(Q(a_c) - Q(a_h)), which fires almost always. Here the members of an ensemble vote, with a
margin tau_Q calibrated on the unimpaired expert. The copilot is the expert's mean action, as the
paper has it, or the original's: the command, partly diffused and denoised.

B episodes, A actions, F features, K members of the ensemble, N held-out decisions.
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
from wasp_cli.methods.quantiles import distributions, quantile
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
        ensemble = load_module(QEnsemble, parts.inputs["ida_q"] / "ensemble.safetensors")
        self.ensemble = ensemble.to(parts.device)
        self.expert = parts.skills.expert
        self.diffusion: Assist | None = None  # the copilot; None: the expert is
        if self.config.copilot == "diffusion":
            self.diffusion = load_assist(
                parts.inputs["denoiser"], self.config.ratio, device=parts.device
            )
        self.tau_q = parts.thresholds.get("tau_q", 0.0)
        self.noise = DecisionNoise(parts.device)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        self.noise.reset(rows, seeds)

    def advantage(self, features: Tensor, a_c: Tensor, a_h: Tensor) -> Tensor:
        """Return Q_k(a_c) - Q_k(a_h), [K, B], at features [B, F] for actions [B, A]."""
        gain: Tensor = self.ensemble(features, a_c) - self.ensemble(features, a_h)
        return gain

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A], or the copilot's actions where the ensemble votes for
        them. The signal is the vote [B], from -1 to 1.
        """
        features = latent.features
        a_c = self._copilot(features, a_h, self.noise)
        vote = (self.advantage(features, a_c, a_h) - self.tau_q).sign().mean(0)  # [B]
        intervenes = vote > self.config.vote
        record = blank_record(len(a_h), device=a_h.device)._replace(
            signal=vote, gate=(GATE_METHOD * intervenes).to(torch.int8)
        )
        return Decision(torch.where(intervenes.unsqueeze(-1), a_c, a_h), record)

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_Q to a quantile of the margin [N] at which the vote tips, over commands of the
        expert with exploration noise; return it with the distribution.

        A copilot that draws may propose something else than the expert to the expert itself. There
        tau_Q is at least the same quantile of the expert without noise.
        """
        # Commands of the expert with noise, and what the copilot makes of them.
        features = heldout.latent.features
        expert = self.expert(features)  # [N, A]
        normals = np.random.default_rng(seed).standard_normal(tuple(expert.shape), np.float32)
        noise = torch.from_numpy(normals).to(expert.device)
        a_h = (expert + self.config.exploration * noise).clamp(-1, 1)
        copilots = DecisionNoise(self.noise.device)
        seeds = [derive("ida-copilot", seed, i) for i in range(len(a_h))]
        copilots.reset(torch.ones(len(a_h), dtype=torch.bool), seeds)
        a_c = self._copilot(features, a_h, copilots)
        margin = self._tips(self.advantage(features, a_c, a_h))  # [N]

        # The same without noise. The copilot `expert` then proposes what was commanded, and
        # nothing can be gained.
        own_a_c = self._copilot(features, expert, copilots)
        own_margin = self._tips(self.advantage(features, own_a_c, expert))

        self.tau_q = max(
            quantile(margin, self.config.quantile), quantile(own_margin, self.config.quantile)
        )
        return {
            "tau_q": self.tau_q,
            **distributions({"margin": margin}),
            "expert_rate": float((own_margin > self.tau_q).float().mean()),
        }

    def _tips(self, advantage: Tensor) -> Tensor:
        """Return the largest tau_Q [B] below which the members' advantages [K, B] win the vote."""
        # Of K members, n for the copilot's action and the others against it vote (2 n - K) / K.
        members = len(advantage)
        needed = members
        for n in range(1, members):
            if (2 * n - members) / members > self.config.vote:
                needed = n
                break
        return advantage.sort(0, descending=True).values[needed - 1]

    def _copilot(self, features: Tensor, a_h: Tensor, noise: DecisionNoise) -> Tensor:
        """Return a_c [B, A]."""
        if self.diffusion is None:
            action: Tensor = self.expert(features)
            return action
        return self.diffusion(features, a_h, noise.streams())
