"""A latent reachability filter: the action nearest to the command that keeps a learned safety value
from falling too fast.

Q(h, z, a) is the value of a Hamilton-Jacobi reachability analysis in the latent space (LatentCBF,
Nakamura et al. 2026; stage `reachability`): the worst margin ahead, discounted, if a is executed
and the best fallback follows. The rule is that of the human-centred safety filter (Oh et al. 2025;
`methods.barrier`): of all actions with Q(h, z, a) >= gamma V(h, z) the one closest to the command,
where V is the largest Q. Where V is negative no action satisfies that, and the fallback acts.

B episodes, K candidates, A actions, F features, P points of the segment.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.barrier import BarrierFilter, SafetyValues
from wasp_cli.methods.base import Parts
from wasp_cli.methods.configs import ReachConfig
from wasp_cli.models.reachability import SafetyValue
from wasp_cli.models.weights import load_module

FALLBACK = 0.9  # gamma where it is to be calibrated and no calibration exists: LatentCBF's


class ReachabilityFilter(BarrierFilter):
    """See the module. Its candidates are fixed."""

    config: ReachConfig

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(ReachConfig, config)
        path = parts.inputs["reachability"] / "safety.safetensors"
        self.value = load_module(SafetyValue, path).to(parts.device)
        self.motors = parts.motors
        if self.config.gamma == "calibrated":
            self.gamma = parts.thresholds.get("gamma", FALLBACK)
        else:
            self.gamma = float(self.config.gamma)

        # Candidates: actions spread over the bounds, and the extreme ones; [K, A].
        engine = torch.quasirandom.SobolEngine(parts.world_model.action_size)
        spread = 2 * engine.draw(self.config.candidates) - 1
        self.candidates = torch.cat([spread.to(parts.device), self.value.extremes])

    def _values(self, features: Tensor, a_h: Tensor) -> SafetyValues:
        """Return V, the fallback and Q of the command: V is never below what the command is
        worth.
        """
        fallback, value = self.value.fallback(features)
        command = self.value(features, a_h.unsqueeze(1)).squeeze(1)
        return SafetyValues(fallback, torch.maximum(value, command), command)

    def _nearest(self, features: Tensor, a_h: Tensor, fallback: Tensor, value: Tensor) -> Tensor:
        # Points on the segment from the command to the fallback's action are candidates too.
        count = self.config.segment
        shares = torch.arange(1, count + 1, device=a_h.device).view(1, -1, 1) / count
        points = torch.lerp(a_h.unsqueeze(1), fallback.unsqueeze(1), shares)  # [B, P, A]
        actions = torch.cat([points, self.candidates.expand(len(a_h), -1, -1)], 1)  # [B, P + K, A]
        # Of all actions with the same force the one closest to the command.
        actions = self.motors.least(a_h.unsqueeze(1).expand_as(actions), actions)

        # The nearest of those that meet the condition.
        safe = self.value(features, actions) >= (self.gamma * value).unsqueeze(1)
        distance = (actions - a_h.unsqueeze(1)).norm(dim=-1).masked_fill(~safe, torch.inf)
        least_distance, index = distance.min(1)
        nearest = actions[torch.arange(len(a_h), device=a_h.device), index]
        return torch.where(least_distance.isfinite().unsqueeze(-1), nearest, fallback)
