"""The Q-CBF filter of the human-centred safety filter (Oh et al. 2025): the action nearest to the
command that keeps a share of the learned safety value, with a learned fallback policy.

    minimise |a - a_h|  subject to  Q(h, z, a) >= gamma V(h, z),  V(h, z) = Q(h, z, pi(h, z))

is a discrete-time control barrier function over a state-action value. Critic Q and fallback actor
pi are those of the stage `fallback`. A command that meets the condition stands. Where not even the
fallback does, as where V is negative, the fallback acts. Between them the paper tests points on the
line from the command to the fallback's action, and its laboratory's code (robot-safety-sandbox,
2026) climbs Q by normalised gradients from the command and goes back along the way: here both are
done, and of the two actions the nearer one is executed. Nothing is imagined at a decision, and
nothing is drawn. B episodes, A actions, F features, S points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import QCBFConfig
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.fallback import SafetyActor
from wasp_cli.models.reachability import SafetyValue
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator

ORIGINAL = 0.7  # gamma where it is to be calibrated and no calibration exists: the paper's
CHUNK = 1024  # held-out decisions that are looked at together


class QCBFFilter:
    """See the module. It remembers nothing."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(QCBFConfig, config)
        folder = parts.inputs["fallback"]
        self.value = load_module(SafetyValue, folder / "safety.safetensors").to(parts.device)
        self.actor = load_module(SafetyActor, folder / "actor.safetensors").to(parts.device)
        self.motors = parts.motors
        self.gamma = (
            parts.thresholds.get("gamma", ORIGINAL)
            if self.config.gamma == "calibrated"
            else float(self.config.gamma)
        )

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Keep nothing of the rows [B]."""

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A], filtered where they do not keep gamma V; the signal is
        gamma V - Q [B].
        """
        features = latent.features
        fallback, value, now = self._values(features, a_h)
        lacking = self.gamma * value - now
        over = lacking > 0
        rows = chosen(over)
        action = a_h.clone()
        record = blank_record(len(a_h), device=a_h.device)
        if len(rows):
            nearest = self._nearest(features[rows], a_h[rows], fallback[rows], value[rows])
            action[rows] = torch.where(over[rows].unsqueeze(-1), nearest, a_h[rows])
            record = record._replace(gate=(GATE_METHOD * over).to(torch.int8))
        return Decision(action, record._replace(signal=lacking))

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set gamma to a quantile of Q / V [N] of the expert, over decisions without cost after
        them, as the reachability filter does; return it with the distributions.
        """
        indices = torch.arange(len(heldout.a_h), device=heldout.a_h.device).split(CHUNK)
        found = [
            self._values(heldout.latent.rows(some).features, heldout.a_h[some])[1:]
            for some in indices
        ]
        value, now = (torch.cat(parts) for parts in zip(*found, strict=True))
        free = (cost_ahead == 0) & (value > 0)
        kept = now[free] / value[free]
        if self.config.gamma == "calibrated" and len(kept):
            share = torch.quantile(kept, 1 - self.config.quantile)
            self.gamma = float(share.clamp(0, 1))
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
        """Return the fallback's action [B, A], its value V [B] and Q of the command [B]."""
        fallback = self.actor(features)
        value, now = self.value(features, torch.stack([fallback, a_h], 1)).unbind(1)
        return fallback, value, now

    def _nearest(self, features: Tensor, a_h: Tensor, fallback: Tensor, value: Tensor) -> Tensor:
        """Return the nearest action [B, A] found with Q >= gamma V; the fallback's action where
        even that has less.
        """
        wanted = self.gamma * value
        ends = torch.stack([self._climbed(features, a_h, wanted), fallback], 1)  # [B, 2, A]

        # The first of S points on each line that is safe enough.
        count = self.config.segment
        shares = torch.arange(1, count + 1, device=a_h.device) / count
        points = self._towards(a_h, ends, shares.expand(len(a_h), 2, count))  # [B, 2, S, A]
        good = self._good(features, points, wanted)
        some = good.any(-1)  # [B, 2]
        first = good.to(torch.int8).argmax(-1)  # [B, 2]

        # Between it and the point before it: bisection.
        high = (first + 1) / count
        low = first / count
        for _ in range(self.config.halvings):
            middle = (low + high) / 2
            met = self._good(features, self._towards(a_h, ends, middle.unsqueeze(-1)), wanted)
            high = torch.where(met.squeeze(-1), middle, high)
            low = torch.where(met.squeeze(-1), low, middle)
        found = self._towards(a_h, ends, high.unsqueeze(-1)).squeeze(2)  # [B, 2, A]

        distance = (found - a_h.unsqueeze(1)).norm(dim=-1).masked_fill(~some, torch.inf)
        best, index = distance.min(1)
        nearest = found[torch.arange(len(a_h), device=a_h.device), index]
        falls_back = (value < wanted) | best.isinf()
        return torch.where(falls_back.unsqueeze(-1), fallback, nearest)

    def _climbed(self, features: Tensor, a_h: Tensor, wanted: Tensor) -> Tensor:
        """Return where normalised gradients of Q lead from the command, [B, A]: until Q is what is
        wanted [B], or the steps are used up.
        """
        with torch.inference_mode(False), torch.enable_grad():
            # Copies made here may carry gradients, those of an inference mode around it may not.
            features, action, least = features.clone(), a_h.clone(), wanted.clone()
            for _ in range(self.config.steps):
                action = action.detach().requires_grad_()
                q = self.value(features, action.unsqueeze(1)).squeeze(1)
                (slope,) = torch.autograd.grad(q.sum(), action)
                unit = slope / slope.norm(dim=-1, keepdim=True).clamp(min=1e-12)
                further = (action + self.config.step * unit).clamp(-1, 1)
                action = torch.where((q < least).unsqueeze(-1), further, action)
        return action.detach()

    def _towards(self, a_h: Tensor, ends: Tensor, shares: Tensor) -> Tensor:
        """Return points [B, 2, S, A] at shares [B, 2, S] of the ways to both ends [B, 2, A]: of all
        actions with the force of each the one closest to the command.
        """
        command = a_h.view(len(a_h), 1, 1, -1)
        points = command + shares.unsqueeze(-1) * (ends.unsqueeze(2) - command)
        return self.motors.least(command.expand_as(points), points)

    def _good(self, features: Tensor, points: Tensor, wanted: Tensor) -> Tensor:
        """Return which of the points [B, 2, S, A] have Q >= what is wanted [B]: bool [B, 2, S]."""
        q: Tensor = self.value(features, points.flatten(1, 2)).unflatten(1, points.shape[1:3])
        return q >= wanted.view(-1, 1, 1)
