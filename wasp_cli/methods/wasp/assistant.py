"""WASP: model-predictive intervention (section 4.2), then model-predictive residual planning (section 4.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import Coverage, WASPConfig
from wasp_cli.methods.noise import DecisionNoise, gumbel, normal, uniform
from wasp_cli.methods.record import Planned, blank_record
from wasp_cli.methods.wasp.gates import TAU_R_FALLBACK, Gain, Signals, probe, resolved_tau_c, safety_gate
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.methods.wasp.planner import Plan, plan_residuals, propose
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator


def effective(config: WASPConfig) -> WASPConfig:
    """Return the configuration that a variant stands for: `no-rollout` is a single imagined step with both critics."""
    if config.variant == "no-rollout":
        return config.model_copy(update={"horizon": 1, "residual_steps": 1, "bootstrap_cost": True, "bootstrap_reward": True})
    return config


def wasp(config: Config, parts: Parts) -> WASP:
    """Build WASP over the trained world model and critics."""
    critics = load_module(LatentCritics, parts.inputs["critics"] / "critics.safetensors")
    whole = cast(WASPConfig, config)
    imagination = Imagination(parts.world_model, critics, effective(whole), parts.gamma_r, parts.gamma_c, parts.lam)
    return WASP(whole, imagination, parts.thresholds)


class WASP:
    """The assistant. Decisions of a batch are independent; each draws from its own episode's stream."""

    def __init__(self, config: WASPConfig, imagination: Imagination, thresholds: Mapping[str, float]) -> None:
        """WASP over any world model; `imagination` has the effective configuration of the variant."""
        self.whole, self.config, self.imagination = config, imagination.config, imagination
        self.tau_c = resolved_tau_c(self.config, thresholds)
        calibrated = thresholds.get("tau_r", TAU_R_FALLBACK)
        self.tau_r = calibrated if self.config.tau_r == "calibrated" else float(self.config.tau_r)
        self.noise = DecisionNoise()
        self.plan = torch.zeros(0)  # [B, L, A] of the last decision
        self.warm = torch.zeros(0, dtype=torch.bool)  # [B] it intervened
        self.kept = torch.zeros(0)  # [B, L, A] what Case II chose last, shifted to now
        self.kept_for = torch.zeros(0, dtype=torch.long)  # [B] decisions for which it stays a candidate

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        size = (len(rows), self.config.residual_steps, self.imagination.model.action_size)
        if self.plan.shape != size:
            self.plan, self.warm = torch.zeros(size), torch.zeros(len(rows), dtype=torch.bool)
            self.kept, self.kept_for = torch.zeros(size), torch.zeros(len(rows), dtype=torch.long)
        # A plan never crosses the boundary of an episode.
        self.plan = torch.where(rows.view(-1, 1, 1), 0.0, self.plan)
        self.kept = torch.where(rows.view(-1, 1, 1), 0.0, self.kept)
        self.warm, self.kept_for = self.warm & ~rows, torch.where(rows, 0, self.kept_for)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Ask both gates, and plan a correction for the decisions where one fired.

        Args:
            latent: [B, .] filtered.
            a_h: [B, A] commands within the bounds.
            operator: of B rows; it has just issued them.
        """
        # Begin with the commands: no gate fired, nothing is planned.
        batch = len(a_h)
        start = Situation(latent, a_h, operator, torch.arange(batch))
        generators = self.noise.next()
        record = blank_record(batch)
        action, gate, delta_g = a_h.clone(), record.gate, record.delta_g
        planned = Planned.nothing(batch, self.config.iterations, *self.plan.shape[1:])
        plan, warm = torch.zeros_like(self.plan), torch.zeros_like(self.warm)
        recovering = torch.zeros_like(self.warm)

        # Imagine the operator alone: G^(c) and G^(r) of the nominal rollouts (Eq. 9-10).
        nominal, gate_draws = self._nominal(start, generators)

        # Safety gate: fires where the nominal cost return exceeds tau_c (Eq. 9).
        fired = safety_gate(nominal.cost, self.tau_c)
        if self.config.variant == "task-only":
            fired = torch.zeros_like(fired)
        # Candidates meet the gate's own draws: where it fired, doing nothing is not suddenly safe.
        search_draws = gate_draws.first(self.config.rollouts)

        def carry_out(rows: Tensor, made: Plan, kind: int) -> None:
            # Execute the first residual of the plan (Eq. 18), and note the plan.
            action[rows] = (a_h[rows] + made.residuals[:, 0]).clamp(-1, 1)
            gate[rows] = kind
            plan[rows], warm[rows], recovering[rows] = made.residuals, True, ~made.found_safe
            found = (
                made.residuals, made.safe.to(torch.int16), made.case2, made.predicted.cost, made.predicted.reward,
                made.alone.cost, made.alone.reward,
            )  # fmt: skip
            for field, value in zip(planned, found, strict=True):
                field[rows] = value

        # Where the safety gate fired: search a residual plan (Eq. 13-17), and look again whether the command needs it.
        rows = fired.nonzero().flatten()
        if len(rows):
            made = self._plan(start.select(rows), search_draws.rows(rows), generators, None)
            carry_out(rows, self._rechecked(made), GATE_SAFETY)

        # Task gate, where the safety gate is silent: the best safe probe candidate must gain more return than tau_r (Eq. 11-12).
        rows = (~fired).nonzero().flatten()
        if len(rows) and self.config.variant != "safety-only":
            quiet = start.select(rows)
            candidates = self._candidates(rows, generators)
            gain = self._probe(quiet, candidates, search_draws.rows(rows), generators)
            delta_g[rows] = gain.delta_g
            worth = (gain.delta_g > self.tau_r).nonzero().flatten()
            if len(worth):
                # Where it fired: search on from the probe, which is the first iteration (Eq. 13-17).
                first = (candidates[worth], Returns(*(field[worth] for field in gain.returns)))
                chosen = rows[worth]
                carry_out(chosen, self._plan(start.select(chosen), search_draws.rows(chosen), generators, first), GATE_TASK)

        # Keep the plans as the next decision's starting point.
        self._remember(plan, warm, recovering)
        return Decision(action, record._replace(g_cost=nominal.cost, g_return=nominal.reward), planned)

    def nominal(self, latent: Latent, a_h: Tensor, operator: Operator) -> Returns:
        """Return what the operator alone leads to (Eq. 9-10), [B] each: all that a decision costs where no gate goes on from there."""
        return self._nominal(Situation(latent, a_h, operator, torch.arange(len(a_h))), self.noise.next())[0]

    def foreseen_cost(self, latent: Latent, a_h: Tensor, operator: Operator) -> Tensor:
        """Return what the safety gate reads [B] (Eq. 9), with the draws of a decision, and nothing else imagined."""
        return self.nominal(latent, a_h, operator).cost

    def _nominal(self, start: Situation, generators: Sequence[np.random.Generator]) -> tuple[Returns, Draws]:
        draws = self._draws(generators, start.operator, self.config.gate_rollouts)
        return self.imagination.nominal(start, draws), draws

    def _remember(self, plan: Tensor, warm: Tensor, recovering: Tensor) -> None:
        """Keep the plans for the next decision, and those of Case II for some more."""
        self.plan, self.warm = plan, warm
        self.kept_for = torch.where(recovering, self.config.case2_memory, (self.kept_for - 1).clamp(min=0))
        kept = shifted(torch.where(recovering.view(-1, 1, 1), plan, self.kept))
        self.kept = torch.where((self.kept_for > 0).view(-1, 1, 1), kept, 0.0)

    def calibrate(self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int) -> dict[str, float]:
        """Return tau_r, tau_c, and the distributions of both gates' signals [N] under the unimpaired expert."""
        everyone = torch.ones(len(heldout.a_h), dtype=torch.bool)
        self.reset(everyone, [seed + i for i in range(len(heldout.a_h))])
        generators = self.noise.next()
        whole = replace(self.imagination, config=self.whole.model_copy(update={"variant": "full"}))
        cost, whole_cost, gain = [], [], []
        for chunk in everyone.nonzero().flatten().split(64):
            own = [generators[i] for i in chunk.tolist()]
            start = Situation(heldout.latent.rows(chunk), heldout.a_h[chunk], operator, chunk)
            draws = self._draws(own, operator, self.config.gate_rollouts, self.whole.horizon)
            whole_cost.append(whole.nominal(start, draws).cost)
            draws = draws.steps(self.config.horizon)
            cost.append(self.imagination.nominal(start, draws).cost)
            fresh = self._draws(own, operator, self.config.gate_rollouts)
            candidates = propose(*self._start_distribution(chunk), normal(own, self.config.probe, *self.plan.shape[1:]))
            gain.append((start, candidates, draws.first(self.config.rollouts), fresh))
        found = Signals(torch.cat(cost), torch.cat(whole_cost), cost_ahead)
        fixed = self.whole.tau_c
        tau_c = found.own_tau_c(fixed) if self.config.variant == "no-rollout" and not isinstance(fixed, Coverage) else self.tau_c
        gains = torch.cat([probe(self.imagination, *case, tau_c).delta_g for case in gain])
        return found.thresholds(tau_c, gains, self.config)

    def _probe(self, start: Situation, candidates: Tensor, search: Draws, generators: Sequence[np.random.Generator]) -> Gain:
        own = [generators[i] for i in start.rows.tolist()]
        fresh = self._draws(own, start.operator, self.config.gate_rollouts)
        return probe(self.imagination, start, candidates, search, fresh, self.tau_c)

    def _candidates(self, rows: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
        own = [generators[i] for i in rows.tolist()]
        return propose(*self._start_distribution(rows), normal(own, self.config.probe, *self.plan.shape[1:]), self.kept[rows])

    def _plan(
        self, start: Situation, draws: Draws, generators: Sequence[np.random.Generator], first: tuple[Tensor, Returns] | None
    ) -> Plan:
        own = [generators[i] for i in start.rows.tolist()]
        config = self.config
        normals = normal(own, config.iterations, config.candidates, *self.plan.shape[1:])
        mean, _ = self._start_distribution(start.rows)
        fresh = self._draws(own, start.operator, config.gate_rollouts) if config.finalists else None
        kept = self.kept[start.rows]
        return plan_residuals(self.imagination, start, mean, normals, draws, self.tau_c, first=first, fresh=fresh, kept=kept)

    def _rechecked(self, made: Plan) -> Plan:
        """Let the command stand where the gate had fired by chance: it is safe on fresh rollouts, and the plan gains no more than noise."""
        if not (self.config.recheck and self.config.finalists):
            return made
        worth = made.predicted.reward - made.alone.reward > (torch.inf if self.config.variant == "safety-only" else self.tau_r)
        stands = (made.alone.cost <= self.tau_c) & ~worth
        return made._replace(
            residuals=torch.where(stands.view(-1, 1, 1), 0.0, made.residuals),
            predicted=Returns(*(torch.where(stands, *fields) for fields in zip(made.alone, made.predicted, strict=True))),
        )

    def _start_distribution(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and std [B, L, A]: the last plan shifted by one with 0 appended where the last decision intervened, else 0."""
        mean = torch.where(self.warm[rows].view(-1, 1, 1), shifted(self.plan[rows]), 0.0)
        return mean, torch.full_like(mean, self.config.initial_std)

    def _draws(self, generators: Sequence[np.random.Generator], operator: Operator, rollouts: int, horizon: int | None = None) -> Draws:
        horizon = horizon or self.config.horizon
        return Draws(
            gumbel(generators, horizon, rollouts, self.imagination.model.noise_size), uniform(generators, horizon, rollouts, operator.draws)
        )


def shifted(plan: Tensor) -> Tensor:
    """Return what is left of plans [B, L, A] one decision later, with 0 appended."""
    return torch.cat([plan[:, 1:], torch.zeros_like(plan[:, :1])], 1)
