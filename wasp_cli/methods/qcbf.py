"""The Q-CBF filter of the human-centred safety filter (Oh et al. 2025): the action nearest to the
command that keeps a share of the learned safety value, with a learned fallback policy.

    minimise |a - a_h|  subject to  Q(h, z, a) >= gamma V(h, z),  V(h, z) = Q(h, z, pi(h, z))

(`methods.barrier`). Critic Q and fallback actor pi are those of the stage `fallback`. A command
that meets the condition stands. Where not even the fallback does, as where V is negative, the
fallback acts. Between them the paper tests points on the line from the command to the fallback's
action, and its laboratory's code (robot-safety-sandbox, 2026) climbs Q by normalised gradients from
the command and goes back along the way. Here both are done, and of the two actions the nearer one
is executed.

B episodes, A actions, F features, S points.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.barrier import BarrierFilter, SafetyValues
from wasp_cli.methods.base import Parts
from wasp_cli.methods.configs import QCBFConfig
from wasp_cli.models.fallback import SafetyActor
from wasp_cli.models.reachability import SafetyValue
from wasp_cli.models.weights import load_module

ORIGINAL = 0.7  # gamma where it is to be calibrated and no calibration exists: the paper's


class QCBFFilter(BarrierFilter):
    """See the module."""

    config: QCBFConfig

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(QCBFConfig, config)
        folder = parts.inputs["fallback"]
        self.value = load_module(SafetyValue, folder / "safety.safetensors").to(parts.device)
        self.actor = load_module(SafetyActor, folder / "actor.safetensors").to(parts.device)
        self.motors = parts.motors
        if self.config.gamma == "calibrated":
            self.gamma = parts.thresholds.get("gamma", ORIGINAL)
        else:
            self.gamma = float(self.config.gamma)

    def _values(self, features: Tensor, a_h: Tensor) -> SafetyValues:
        fallback = self.actor(features)
        both = self.value(features, torch.stack([fallback, a_h], 1))  # [B, 2]
        return SafetyValues(fallback, both[:, 0], both[:, 1])

    def _nearest(self, features: Tensor, a_h: Tensor, fallback: Tensor, value: Tensor) -> Tensor:
        # Two lines from the command: to where the steps lead, and to the fallback's action.
        least = self.gamma * value  # [B] what Q has to be
        ends = torch.stack([self._climbed(features, a_h, least), fallback], 1)  # [B, 2, A]

        # The first of S points on each line that is safe enough.
        count = self.config.segment
        shares = torch.arange(1, count + 1, device=a_h.device) / count
        points = self._towards(a_h, ends, shares.expand(len(a_h), 2, count))  # [B, 2, S, A]
        safe = self._safe(features, points, least)
        any_safe = safe.any(-1)  # [B, 2]
        first = safe.to(torch.int8).argmax(-1)  # [B, 2]

        # Bisection between it and the point before it; shares [B, 2] of the way.
        high = (first + 1) / count
        low = first / count
        for _ in range(self.config.halvings):
            middle = (low + high) / 2
            point = self._towards(a_h, ends, middle.unsqueeze(-1))
            middle_safe = self._safe(features, point, least).squeeze(-1)
            high = torch.where(middle_safe, middle, high)
            low = torch.where(middle_safe, low, middle)
        actions = self._towards(a_h, ends, high.unsqueeze(-1)).squeeze(2)  # [B, 2, A]

        # The nearer of the two.
        distance = (actions - a_h.unsqueeze(1)).norm(dim=-1).masked_fill(~any_safe, torch.inf)
        least_distance, index = distance.min(1)
        nearest = actions[torch.arange(len(a_h), device=a_h.device), index]
        falls_back = (value < least) | least_distance.isinf()
        return torch.where(falls_back.unsqueeze(-1), fallback, nearest)

    def _climbed(self, features: Tensor, a_h: Tensor, least: Tensor) -> Tensor:
        """Return where normalised gradients of Q lead from the command, [B, A]: until Q is at
        least `least` [B], or the steps are used up.
        """
        with torch.inference_mode(False), torch.enable_grad():
            # Copies made here may carry gradients, those of an inference mode around it may not.
            features = features.clone()
            action = a_h.clone()
            least = least.clone()
            for _ in range(self.config.steps):
                action = action.detach().requires_grad_()
                q = self.value(features, action.unsqueeze(1)).squeeze(1)
                (slope,) = torch.autograd.grad(q.sum(), action)
                direction = slope / slope.norm(dim=-1, keepdim=True).clamp(min=1e-12)
                further = (action + self.config.step * direction).clamp(-1, 1)
                action = torch.where((q < least).unsqueeze(-1), further, action)
        return action.detach()

    def _towards(self, a_h: Tensor, ends: Tensor, shares: Tensor) -> Tensor:
        """Return points [B, 2, S, A] at shares [B, 2, S] of the ways to both ends [B, 2, A]: of all
        actions with the force of each the one closest to the command.
        """
        command = a_h.view(len(a_h), 1, 1, -1)
        points = command + shares.unsqueeze(-1) * (ends.unsqueeze(2) - command)
        return self.motors.least(command.expand_as(points), points)

    def _safe(self, features: Tensor, points: Tensor, least: Tensor) -> Tensor:
        """Return which of the points [B, 2, S, A] have at least Q = `least` [B]: bool [B, 2, S]."""
        q: Tensor = self.value(features, points.flatten(1, 2)).unflatten(1, points.shape[1:3])
        return q >= least.view(-1, 1, 1)
