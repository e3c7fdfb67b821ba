"""From the gates' signals under the unimpaired expert to thresholds."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig

TAU_R_FALLBACK = 0.5
"""tau_r where it is to be calibrated and no calibration exists yet."""


class Signals(NamedTuple):
    """Nominal cost returns of K held-out decisions."""

    cost: Tensor
    """[K] of the variant (Eq. 9)"""
    whole_cost: Tensor
    """[K] of the whole method"""
    cost_ahead: Tensor
    """[K] costly decisions that really followed within the window; NaN where the episode has fewer left"""

    def own_tau_c(self, tau_c: float) -> float:
        """The threshold that lets through as many of the expert's decisions as `tau_c` does for the whole method."""
        rate = float((self.whole_cost > tau_c).float().mean())
        return quantile(self.cost, 1.0 - rate)

    def thresholds(self, tau_c: float, gains: Tensor, config: WASPConfig) -> dict[str, float]:
        """tau_c and tau_r, and the distributions that they stand in.

        Args:
            tau_c: in force.
            gains: [K] Delta G of Eq. 12; minus infinity where no candidate was feasible.
            config: of the variant.
        """
        quiet = gains[(self.cost <= tau_c) & gains.isfinite()]  # the task gate is asked only where safety is silent
        free = self.cost[self.cost_ahead == 0]
        tau_r = max(quantile(quiet, config.tau_r_quantile), config.tau_r_floor) if len(quiet) else TAU_R_FALLBACK
        spread = {
            f"{name}_{label}": quantile(values, q)
            for name, values in (("gain", quiet), ("g_cost", self.cost), ("g_cost_free", free))
            for label, q in (("median", 0.5), ("p90", 0.90), ("p95", 0.95))
        }
        return {"tau_c": tau_c, "tau_r": tau_r, **spread, "safety_rate": float((self.cost > tau_c).float().mean())}


def quantile(values: Tensor, q: float) -> float:
    """A quantile, NaN of nothing."""
    return float(torch.quantile(values, q)) if len(values) else float("nan")
