"""The two model-predictive intervention functions (section 4.2), and the calibration of their thresholds.

Safety comes first; the task gate is asked only where safety is silent. B = decisions, K = held-out decisions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.methods.configs import Coverage, WASPConfig
from wasp_cli.methods.wasp.candidates import Batch
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation

TAU_C_FALLBACK, TAU_R_FALLBACK = 0.5, 0.5
"""Thresholds that are to be calibrated, where no calibration exists yet."""


class Gain(NamedTuple):
    """The outcome of the task gate's probe."""

    delta_g: Tensor
    """Delta G_t of Eq. 12 [B]; minus infinity where no candidate is feasible"""
    best: Tensor
    """[B] index of the corrected candidate"""


def resolved_tau_c(config: WASPConfig, thresholds: Mapping[str, float]) -> float:
    """Return tau_c in force: the configuration's, or a calibrated one where the configuration or the signal's unit asks for it."""
    fixed = config.tau_c if isinstance(config.tau_c, float | int) else None
    # A single step has another unit than the sum over H, so `no-rollout` brings a threshold of its own.
    if fixed is None or config.variant == "no-rollout":
        return thresholds.get("tau_c", TAU_C_FALLBACK if fixed is None else fixed)
    return fixed


def resolved_tau_r(config: WASPConfig, thresholds: Mapping[str, float]) -> float:
    """Return tau_r in force."""
    return thresholds.get("tau_r", TAU_R_FALLBACK) if config.tau_r == "calibrated" else float(config.tau_r)


def safety_gate(nominal: Returns, config: WASPConfig, tau_c: float) -> Tensor:
    """Return where to intervene [B]: the nominal cost return exceeds tau_c (Eq. 9); nowhere in the variant without this gate."""
    fired = nominal.cost > tau_c
    return torch.zeros_like(fired) if config.variant == "task-only" else fired


def probe(candidates: Batch, nominal: Tensor, config: WASPConfig, tau_c: float) -> Gain:
    """Find the feasible candidate of highest penalised return (Eq. 11), and its gain over `nominal` [B], the return of none (Eq. 12)."""
    found = candidates.returns
    feasible = found.cost <= tau_c  # NaN compares false: a broken rollout is not feasible
    best = torch.where(feasible, task_score(found, config.alpha), -torch.inf).argmax(-1)  # [B]
    gain = found.reward.gather(1, best.unsqueeze(1)).squeeze(1) - nominal
    return Gain(torch.where(feasible.any(-1), gain, -torch.inf), best)


def scored_again(imagination: Imagination, start: Situation, candidates: Batch, gain: Gain, fresh: Draws) -> Gain:
    """Return the gain of the probe's winner on fresh rollouts, common to it and the operator alone.

    The maximum of many noisy estimates is biased. Where nothing was feasible, nothing is.
    """
    winner = candidates.take(gain.best.unsqueeze(1))
    nothing = torch.zeros_like(winner.residuals)
    share = () if winner.share is None else (torch.cat([torch.zeros_like(winner.share), winner.share], 1),)
    again = imagination.returns(start, torch.cat([nothing, winner.residuals], 1), fresh, *share, alone=1)
    return gain._replace(delta_g=torch.where(gain.delta_g.isfinite(), again.reward[:, 1] - again.reward[:, 0], -torch.inf))


def task_score(returns: Returns, alpha: float) -> Tensor:
    """Return S_task [B, N] of Eq. 16 (the objective of Eq. 11): G^(r) - alpha sum ||delta||^2; minus infinity where undefined."""
    score = returns.reward - alpha * returns.effort
    return torch.where(score.isnan(), -torch.inf, score)


def safe_score(returns: Returns, alpha: float, tau_c: float) -> Tensor:
    """Return S_safe [B, N] of Eq. 17, to be minimised: [G^(c) - tau_c]_+ + alpha sum ||delta||^2; infinity where undefined."""
    score = (returns.cost - tau_c).clamp(min=0) + alpha * returns.effort
    return torch.where(score.isnan(), torch.inf, score)


class Signals(NamedTuple):
    """Nominal cost returns of K held-out decisions."""

    cost: Tensor
    """[K] of the variant (Eq. 9)"""
    whole_cost: Tensor
    """[K] of the whole method"""
    cost_ahead: Tensor
    """[K] costly decisions that really followed within the window; NaN where the episode has fewer left"""

    def tau_c(self, config: WASPConfig, known: float) -> float:
        """Return the threshold of the safety gate: `known` where episodes of the operators have given it.

        `calibrated` is a quantile of the signal over the decisions after which nothing cost. In the unit of `no-rollout` it is the one that
        lets through as many of the expert's decisions as that of the whole method.
        """
        single = config.variant == "no-rollout"
        whole = self.whole_cost if single else self.cost
        tau_c = config.tau_c
        if isinstance(tau_c, Coverage):
            return known
        if tau_c == "calibrated":
            free = whole[self.cost_ahead == 0]
            tau_c = quantile(free, config.tau_c_quantile) if len(free) else TAU_C_FALLBACK
        if not single:
            return tau_c
        return quantile(self.cost, 1.0 - float((self.whole_cost > tau_c).float().mean()))

    def thresholds(self, tau_c: float, gains: Tensor, config: WASPConfig) -> dict[str, float]:
        """Return tau_c and tau_r, and the distributions that they stand in.

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
    """Return a quantile of values [K]; NaN of nothing."""
    return float(torch.quantile(values, q)) if len(values) else float("nan")
