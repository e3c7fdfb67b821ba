"""A latent reachability filter: the action nearest to the command that keeps a learned safety value
from falling too fast.

Q(h, z, a) is the value of a Hamilton-Jacobi reachability analysis in the latent space (LatentCBF,
Nakamura et al. 2026; stage `reachability`): the worst margin ahead, discounted, if a is executed
and the best fallback follows. The rule is that of the human-centred safety filter (Oh et al. 2025),
a discrete-time control barrier function: of all actions with Q(h, z, a) >= gamma V(h, z) the one
closest to the command; V is the largest Q. Where V is negative no action satisfies that, and the
fallback acts. Nothing is imagined at a decision. B episodes, K candidates, A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import ReachConfig
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.reachability import SafetyValue
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator

FALLBACK = 0.9  # gamma where it is to be calibrated and no calibration exists: LatentCBF's
CHUNK = 1024  # held-out decisions that are looked at together


class ReachabilityFilter:
    """See the module. Its candidates are fixed, so that it draws nothing and remembers nothing."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(ReachConfig, config)
        path = parts.inputs["reachability"] / "safety.safetensors"
        self.value, self.motors = load_module(SafetyValue, path).to(parts.device), parts.motors
        self.gamma = (
            parts.thresholds.get("gamma", FALLBACK)
            if self.config.gamma == "calibrated"
            else float(self.config.gamma)
        )
        spread = (
            2
            * torch.quasirandom.SobolEngine(parts.world_model.action_size).draw(
                self.config.candidates
            )
            - 1
        )
        self.candidates = torch.cat([spread.to(parts.device), self.value.extremes])  # [K, A]

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Keep nothing of the rows [B]."""

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        features = latent.features
        fallback, value, now = self._values(features, a_h)
        lacking = self.gamma * value - now
        over = lacking > 0
        rows = chosen(over)
        action, record = a_h.clone(), blank_record(len(a_h), device=a_h.device)
        if len(rows):
            nearest = self._nearest(features[rows], a_h[rows], fallback[rows], value[rows])
            action[rows] = torch.where(over[rows].unsqueeze(-1), nearest, a_h[rows])
            record = record._replace(gate=(GATE_METHOD * over).to(torch.int8))
        return Decision(action, record._replace(signal=lacking))

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set gamma to a quantile of Q / V [N] of the expert, over decisions without cost after
        them; return it with the distributions.
        """
        chunks = [
            torch.arange(begin, min(begin + CHUNK, len(heldout.a_h)))
            for begin in range(0, len(heldout.a_h), CHUNK)
        ]
        found = [self._values(heldout.latent.rows(c).features, heldout.a_h[c])[1:] for c in chunks]
        value, now = (torch.cat(parts) for parts in zip(*found, strict=True))
        free = (cost_ahead == 0) & (value > 0)
        kept = now[free] / value[free]
        if self.config.gamma == "calibrated":
            self.gamma = (
                float(torch.quantile(kept, 1 - self.config.quantile).clamp(0, 1))
                if len(kept)
                else FALLBACK
            )
        spread = {
            f"{name}_{label}": float(torch.quantile(values, q)) if len(values) else float("nan")
            for name, values in (("v", value), ("kept_free", kept))
            for label, q in (("p05", 0.05), ("p10", 0.10), ("median", 0.5))
        }
        return {
            "gamma": self.gamma,
            **spread,
            "expert_rate": float((now < self.gamma * value).float().mean()),
        }

    def _values(self, features: Tensor, a_h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the fallback's action [B, A], V [B] and Q of the command [B]: V is never below
        what the command is worth.
        """
        fallback, value = self.value.fallback(features)
        now = self.value(features, a_h.unsqueeze(1)).squeeze(1)
        return fallback, torch.maximum(value, now), now

    def _nearest(self, features: Tensor, a_h: Tensor, fallback: Tensor, value: Tensor) -> Tensor:
        """Return the candidate [B, A] nearest to the command with Q >= gamma V; the fallback's
        action where there is none.
        """
        share = (
            torch.arange(1, self.config.segment + 1, device=a_h.device).view(1, -1, 1)
            / self.config.segment
        )
        points = torch.lerp(a_h.unsqueeze(1), fallback.unsqueeze(1), share)
        actions = torch.cat([points, self.candidates.expand(len(a_h), -1, -1)], 1)
        # Of all actions with the same force the one closest to the command.
        actions = self.motors.least(a_h.unsqueeze(1).expand_as(actions), actions)
        good = self.value(features, actions) >= (self.gamma * value).unsqueeze(1)
        distance = (actions - a_h.unsqueeze(1)).norm(dim=-1).masked_fill(~good, torch.inf)
        best, index = distance.min(1)
        nearest = actions[torch.arange(len(a_h), device=a_h.device), index]
        return torch.where(best.isfinite().unsqueeze(-1), nearest, fallback)
