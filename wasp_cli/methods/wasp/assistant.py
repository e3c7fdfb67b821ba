"""WASP: model-predictive intervention (section 4.2), then model-predictive residual planning (section 4.3)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts, blank_record
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import DecisionNoise, gumbel, normal, uniform
from wasp_cli.methods.wasp.gates import Gain, probe, safety_gate
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.methods.wasp.residual import Plan, plan_residuals, propose
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.weights import load_weights, read_arguments
from wasp_cli.operators.base import Operator

TAU_R_FALLBACK = 0.5
"""tau_r where it is to be calibrated and no calibration exists yet."""


def effective(config: WASPConfig) -> WASPConfig:
    """The configuration that a variant stands for: `no-rollout` is a single imagined step with both critics."""
    if config.variant == "no-rollout":
        return config.model_copy(update={"horizon": 1, "residual_steps": 1, "bootstrap_cost": True})
    return config


class WASP:
    """The assistant. Decisions of a batch are independent; each draws from its own episode's stream."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.whole = cast(WASPConfig, config)
        self.config = effective(self.whole)
        path = parts.inputs["critics"] / "critics.safetensors"
        critics = LatentCritics(**read_arguments(path))
        load_weights(critics, path)
        self.imagination = Imagination(parts.world_model, critics, self.config, parts.gamma_r, parts.gamma_c, parts.lam)
        # A single step has another unit than the sum over H, so `no-rollout` brings a threshold of its own.
        own = self.config.variant == "no-rollout"
        self.tau_c = parts.thresholds.get("tau_c", self.config.tau_c) if own else self.config.tau_c
        calibrated = parts.thresholds.get("tau_r", TAU_R_FALLBACK)
        self.tau_r = calibrated if self.config.tau_r == "calibrated" else float(self.config.tau_r)
        self.noise = DecisionNoise()
        self.plan = torch.zeros(0)  # [B, L, A] of the last decision
        self.warm = torch.zeros(0, dtype=torch.bool)  # [B] it intervened

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        size = (len(rows), self.config.residual_steps, self.imagination.model.action_size)
        if self.plan.shape != size:
            self.plan, self.warm = torch.zeros(size), torch.zeros(len(rows), dtype=torch.bool)
        # A plan never crosses the boundary of an episode.
        self.plan = torch.where(rows.view(-1, 1, 1), torch.zeros_like(self.plan), self.plan)
        self.warm = self.warm & ~rows

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Both gates, then a plan for the decisions where one fired."""
        batch = len(a_h)
        start = Situation(latent, a_h, operator, torch.arange(batch))
        generators = self.noise.next()
        record = blank_record(batch)
        action, gate = a_h.clone(), record.gate
        plan, warm = torch.zeros_like(self.plan), torch.zeros_like(self.warm)

        gate_draws = self._draws(generators, operator, self.config.gate_rollouts)
        g_cost = self.imagination.nominal(start, gate_draws).cost  # Eq. 9
        fired = safety_gate(g_cost, self.tau_c)
        if self.config.variant == "task-only":
            fired = torch.zeros_like(fired)
        # The candidates meet the gate's own draws: where it fired, doing nothing is not suddenly safe.
        search_draws = gate_draws.first(self.config.rollouts)
        delta_g, safe, case2 = record.delta_g, record.safe, record.case2_share

        def carry_out(rows: Tensor, made: Plan, kind: int) -> None:
            action[rows] = (a_h[rows] + made.residuals[:, 0]).clamp(-1, 1)  # Eq. 18
            gate[rows] = kind
            plan[rows], warm[rows] = made.residuals, True
            safe[rows], case2[rows] = made.safe.to(safe.dtype), made.case2_share

        rows = fired.nonzero().flatten()
        if len(rows):
            carry_out(rows, self._plan(start.select(rows), search_draws.rows(rows), generators, None), GATE_SAFETY)

        rows = (~fired).nonzero().flatten()
        if len(rows) and self.config.variant != "safety-only":
            quiet = start.select(rows)
            candidates = self._candidates(rows, generators)
            gain = self._probe(quiet, candidates, search_draws.rows(rows), generators)
            delta_g[rows] = gain.delta_g
            worth = (gain.delta_g > self.tau_r).nonzero().flatten()  # Eq. 12
            if len(worth):
                first = (candidates[worth], Returns(*(field[worth] for field in gain.returns)))
                chosen = rows[worth]
                carry_out(chosen, self._plan(start.select(chosen), search_draws.rows(chosen), generators, first), GATE_TASK)

        self.plan, self.warm = plan, warm
        record = record._replace(gate=gate, g_cost=g_cost, delta_g=delta_g, safe=safe, case2_share=case2)
        return Decision(action, record)

    def calibrate(self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int) -> dict[str, float]:
        """The distribution of both gates' signals under the unimpaired expert: tau_r and quantiles for tau_c."""
        gains, costs, whole_costs = [], [], []
        whole = dataclasses.replace(self.imagination, config=self.whole.model_copy(update={"variant": "full"}))
        everyone = torch.ones(len(heldout.a_h), dtype=torch.bool)
        self.reset(everyone, [seed + i for i in range(len(heldout.a_h))])
        generators = self.noise.next()
        for chunk in torch.arange(len(heldout.a_h)).split(64):
            own = [generators[i] for i in chunk.tolist()]
            start = Situation(heldout.latent.rows(chunk), heldout.a_h[chunk], operator, chunk)
            draws = self._draws(own, operator, self.config.gate_rollouts, self.whole.horizon)
            whole_costs.append(whole.nominal(start, draws).cost)
            draws = draws.steps(self.config.horizon)
            costs.append(self.imagination.nominal(start, draws).cost)
            fresh = self._draws(own, operator, self.config.gate_rollouts)
            candidates = propose(*self._start_distribution(chunk), normal(own, self.config.probe, *self.plan.shape[1:]))
            gains.append((start, candidates, draws.first(self.config.rollouts), fresh))
        cost = torch.cat(costs)
        # The same share of the expert's decisions for every variant: for the whole method that is its tau_c itself.
        rate = float((torch.cat(whole_costs) > self.whole.tau_c).float().mean())
        tau_c = self.tau_c if self.config.variant != "no-rollout" else _quantile(cost, 1.0 - rate)
        gain = torch.cat([probe(self.imagination, *case, tau_c).delta_g for case in gains])
        quiet = gain[(cost <= tau_c) & gain.isfinite()]  # the task gate is asked only where safety is silent
        free = cost_ahead == 0
        return {
            "tau_c": tau_c,
            "tau_r": max(_quantile(quiet, self.config.tau_r_quantile), self.config.tau_r_floor) if len(quiet) else TAU_R_FALLBACK,
            "gain_median": _quantile(quiet, 0.5), "gain_p90": _quantile(quiet, 0.90), "gain_p95": _quantile(quiet, 0.95),
            "g_cost_median": _quantile(cost, 0.5), "g_cost_p90": _quantile(cost, 0.90), "g_cost_p95": _quantile(cost, 0.95),
            "g_cost_free_p90": _quantile(cost[free], 0.90), "g_cost_free_p95": _quantile(cost[free], 0.95),
            "safety_rate": float((cost > tau_c).float().mean()),
        }  # fmt: skip

    def _probe(self, start: Situation, candidates: Tensor, search: Draws, generators: Sequence[np.random.Generator]) -> Gain:
        own = [generators[i] for i in start.rows.tolist()]
        fresh = self._draws(own, start.operator, self.config.gate_rollouts)
        return probe(self.imagination, start, candidates, search, fresh, self.tau_c)

    def _candidates(self, rows: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
        own = [generators[i] for i in rows.tolist()]
        return propose(*self._start_distribution(rows), normal(own, self.config.probe, *self.plan.shape[1:]))

    def _plan(
        self, start: Situation, draws: Draws, generators: Sequence[np.random.Generator], first: tuple[Tensor, Returns] | None
    ) -> Plan:
        own = [generators[i] for i in start.rows.tolist()]
        config = self.config
        normals = normal(own, config.iterations, config.candidates, *self.plan.shape[1:])
        mean, _ = self._start_distribution(start.rows)
        fresh = self._draws(own, start.operator, config.gate_rollouts) if config.finalists else None
        return plan_residuals(self.imagination, start, mean, normals, draws, self.tau_c, first, fresh)

    def _start_distribution(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std [B, L, A]: the last plan shifted by one with 0 appended where the last decision intervened, else 0."""
        shifted = torch.cat([self.plan[rows, 1:], torch.zeros_like(self.plan[rows, :1])], 1)
        mean = torch.where(self.warm[rows].view(-1, 1, 1), shifted, torch.zeros_like(shifted))
        return mean, torch.full_like(mean, self.config.initial_std)

    def _draws(self, generators: Sequence[np.random.Generator], operator: Operator, rollouts: int, horizon: int | None = None) -> Draws:
        horizon = horizon or self.config.horizon
        return Draws(
            gumbel(generators, horizon, rollouts, self.imagination.model.noise_size), uniform(generators, horizon, rollouts, operator.draws)
        )


def _quantile(values: Tensor, q: float) -> float:
    """A quantile, NaN of nothing."""
    return float(torch.quantile(values, q)) if len(values) else float("nan")
