"""WASP: model-predictive intervention (section 4.2), then model-predictive residual planning (section 4.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.errors import WaspError
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import DecisionNoise, gumbel, normal, uniform
from wasp_cli.methods.record import Planned, blank_record
from wasp_cli.methods.wasp.candidates import Batch, none_taken, propose, takeovers
from wasp_cli.methods.wasp.gates import Gain, Signals, probe, resolved_tau_c, resolved_tau_r, safety_gate, scored_again
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.methods.wasp.operator_model import imagined_operator, load_clone
from wasp_cli.methods.wasp.planner import Plan, plan_residuals
from wasp_cli.methods.wasp.witness import Witness, load_witness
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator
from wasp_cli.operators.cloned import ClonedOperator

CHUNK = 64
"""Held-out decisions that are looked at together."""


def effective(config: WASPConfig) -> WASPConfig:
    """Return the configuration that a variant stands for: `no-rollout` is a single imagined step with both critics."""
    if config.variant == "no-rollout":
        return config.model_copy(
            update={"horizon": 1, "residual_steps": 1, "bootstrap_cost": True, "bootstrap_reward": True, "witness": "sum"}
        )
    return config


def wasp(config: Config, parts: Parts) -> WASP:
    """Build WASP over the trained world model and critics."""
    critics = load_module(LatentCritics, parts.inputs["critics"] / "critics.safetensors")
    whole = cast(WASPConfig, config)
    config = effective(whole)
    imagination = Imagination(
        parts.world_model, critics, config, parts.gamma_r, parts.gamma_c, parts.lam, expert=parts.skills.expert
    )  # fmt: skip
    witness = None if config.witness == "sum" else load_witness(config, parts.inputs["lookahead"])
    clone = None
    if config.operator_model == "cloned":
        clone = load_clone(parts.inputs["clone"], parts.skills.expert, parts.world_model.action_size)
    return WASP(whole, imagination, parts.thresholds, witness, clone)


class Look(NamedTuple):
    """What the gates see of B decisions: one batch of rollouts."""

    nominal: Returns
    """[B] of the operator alone (Eq. 9-10)"""
    taken: Batch | None
    """takeovers; None where there are none"""
    baseline: Tensor
    """[B] return of the operator alone on the rollouts of the takeovers"""
    draws: Draws
    """of these rollouts"""
    foreseen: Tensor | None
    """[B] probability of a cost by the second witness; None where it is not asked"""

    def rows(self, index: Tensor) -> Look:
        """Select some of the decisions (indices [R])."""
        taken = None if self.taken is None else self.taken.rows(index)
        return Look(Returns(*(values[index] for values in self.nominal)), taken, self.baseline[index], self.draws.rows(index), None)


class WASP:
    """The assistant. Decisions of a batch are independent; each draws from its own episode's stream."""

    def __init__(
        self,
        config: WASPConfig,
        imagination: Imagination,
        thresholds: Mapping[str, float],
        witness: Witness | None = None,
        clone: ClonedOperator | None = None,
    ) -> None:
        """WASP over any world model; `imagination` has the effective configuration of the variant.

        Raises:
            WaspError: the safety gate asks for a second witness, and there is none.
        """
        if imagination.config.witness != "sum" and witness is None:
            raise WaspError(f"wasp.witness is '{imagination.config.witness}', but there is no look ahead here", "set wasp.witness=sum")
        self.clone = clone
        self.witness = witness if imagination.config.witness != "sum" else None
        self.whole, self.config, self.imagination = config, imagination.config, imagination
        self.tau_c, self.tau_r = resolved_tau_c(self.config, thresholds), resolved_tau_r(self.config, thresholds)
        self.noise = DecisionNoise()
        self.plan = torch.zeros(0)  # [B, L, A] of the last decision
        self.warm = torch.zeros(0, dtype=torch.bool)  # [B] it intervened
        self.kept = torch.zeros(0)  # [B, L, A] what Case II chose last, shifted to now
        self.kept_for = torch.zeros(0, dtype=torch.long)  # [B] decisions for which it stays a candidate
        self.exceeded = torch.zeros(0, dtype=torch.bool)  # [B] the nominal cost return exceeded tau_c at the last decision

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        size = (len(rows), self.config.residual_steps, self.imagination.model.action_size)
        if self.plan.shape != size:
            self.plan, self.warm = torch.zeros(size), torch.zeros(len(rows), dtype=torch.bool)
            self.kept, self.kept_for = torch.zeros(size), torch.zeros(len(rows), dtype=torch.long)
            self.exceeded = torch.zeros(len(rows), dtype=torch.bool)
        # A plan never crosses the boundary of an episode.
        self.plan = torch.where(rows.view(-1, 1, 1), 0.0, self.plan)
        self.kept = torch.where(rows.view(-1, 1, 1), 0.0, self.kept)
        self.warm, self.kept_for = self.warm & ~rows, torch.where(rows, 0, self.kept_for)
        self.exceeded = self.exceeded & ~rows

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Ask both gates, and plan a correction for the decisions where one fired.

        Args:
            latent: [B, .] filtered.
            a_h: [B, A] commands within the bounds.
            operator: of B rows; it has just issued them.
        """
        # Begin with the commands: no gate fired, nothing is planned.
        batch = len(a_h)
        start = self._situation(latent, a_h, operator)
        generators = self.noise.next()
        record = blank_record(batch)
        action, gate, delta_g = a_h.clone(), record.gate, record.delta_g
        planned = Planned.nothing(batch, self.config.iterations, *self.plan.shape[1:])
        plan, warm = torch.zeros_like(self.plan), torch.zeros_like(self.warm)
        recovering = torch.zeros_like(self.warm)

        # Imagine the operator alone, G^(c) and G^(r) of the nominal rollouts (Eq. 9-10), and beside it the takeovers.
        look = self._look(start, generators)

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

        # Safety gate: fires where the nominal cost return exceeds tau_c (Eq. 9). Search a residual plan (Eq. 13-17), and look again
        # whether the command needs it.
        fired = safety_gate(look.nominal, self.config, self.tau_c, look.foreseen, self.exceeded)
        self.exceeded = look.nominal.cost > self.tau_c
        rows = fired.nonzero().flatten()
        if len(rows) and look.taken is not None and not self.config.safety_search:
            # Without a search where the expert's takeover is safe.
            safe = (look.taken.returns.cost[rows] <= self.tau_c).any(-1)
            known, rows = rows[safe], rows[~safe]
            if len(known):
                part = look.rows(known)
                assert part.taken is not None
                best = probe(part.taken, part.baseline, self.config, self.tau_c).best
                carry_out(known, self._winner(part.taken, best, part), GATE_SAFETY)
        if len(rows):
            made = self._plan(start.select(rows), look.rows(rows), generators, None)
            carry_out(rows, self._rechecked(made), GATE_SAFETY)

        # Task gate, where the safety gate is silent: the best safe candidate must gain more return than tau_r (Eq. 11-12).
        rows = (~fired).nonzero().flatten()
        if len(rows) and self.config.variant != "safety-only":
            asked = look.rows(rows)
            gain, candidates, sampled = self._gain(start.select(rows), asked, generators, self.tau_r)
            delta_g[rows] = gain.delta_g
            worth = (gain.delta_g > self.tau_r).nonzero().flatten()
            chosen = rows[worth]
            if len(worth) and self.config.task_search:
                # Where it fired, search (Eq. 13-17).
                first = sampled.rows(worth) if sampled is not None and self.config.probe_first else None
                carry_out(chosen, self._plan(start.select(chosen), look.rows(chosen), generators, first), GATE_TASK)
            elif len(worth):
                carry_out(chosen, self._winner(candidates.rows(worth), gain.best[worth], asked.rows(worth)), GATE_TASK)

        # Keep the plans as the next decision's starting point.
        self._remember(plan, warm, recovering)
        return Decision(action, record._replace(g_cost=look.nominal.cost, g_return=look.nominal.reward), planned)

    def nominal(self, latent: Latent, a_h: Tensor, operator: Operator) -> Returns:
        """Return what the operator alone leads to (Eq. 9-10), [B] each, at the cost of a decision in which nothing else is imagined."""
        return self._look(self._situation(latent, a_h, operator), self.noise.next()).nominal

    def foreseen_cost(self, latent: Latent, a_h: Tensor, operator: Operator) -> Tensor:
        """Return what the safety gate reads [B] (Eq. 9), with the draws of a decision, and nothing else imagined."""
        start, generators = self._situation(latent, a_h, operator), self.noise.next()
        return self.imagination.nominal(start, self._draws(generators, start.operator, self.config.gate_rollouts)).cost

    def _situation(self, latent: Latent, a_h: Tensor, operator: Operator) -> Situation:
        imagined = imagined_operator(self.config.operator_model, operator, a_h, self.imagination.expert, self.clone)
        return Situation(latent, a_h, imagined, torch.arange(len(a_h)))

    def _look(self, start: Situation, generators: Sequence[np.random.Generator]) -> Look:
        return self._seen(start, self._draws(generators, start.operator, self.config.gate_rollouts))

    def _seen(self, start: Situation, draws: Draws) -> Look:
        batch, actions = start.a_h.shape
        share = takeovers(self.config, batch)
        heard = 0 if self.witness is None else self.witness.commands
        if not share.shape[1]:
            nothing = start.a_h.new_zeros(batch, 1, self.config.residual_steps, actions)
            rolled = self.imagination.rolled(start, nothing, draws, alone=1, heard=heard)
            nominal = Returns(*(values.squeeze(1) for values in rolled.returns))
            return Look(nominal, None, nominal.reward, draws, self._foreseen(start, rolled.issued, 1))
        # One batch: the operator alone several times, so that together it meets all draws, then the takeovers, which meet the first.
        each, every = self.config.takeover_rollouts, self.config.gate_rollouts
        each = every if every % each else each
        several = every // each
        alone = start.a_h.new_zeros(batch, several, self.config.residual_steps, actions)
        residuals = alone[:, :1].expand(-1, several + share.shape[1], -1, -1)
        index = torch.cat([torch.arange(several * each).view(several, each), torch.arange(each).expand(share.shape[1], -1)])
        shares = torch.cat([none_taken(alone), share], 1)
        rolled = self.imagination.rolled(start, residuals, draws, shares, alone=several, index=index, heard=heard)
        returns, realised, issued = rolled
        taken = Batch(realised[:, several:], share, Returns(*(values[:, several:] for values in returns)))
        nominal = Returns(*(values[:, :several].mean(1) for values in returns))
        return Look(nominal, taken, returns.reward[:, 0], draws, self._foreseen(start, issued, several))

    def _foreseen(self, start: Situation, issued: Tensor | None, alone: int) -> Tensor | None:
        """Ask the second witness about the commands [B, N, M, K, A] of the first candidates, the operator alone."""
        if self.witness is None or issued is None:
            return None
        return self.witness.foreseen(start.latent, issued[:, :alone].flatten(1, 2))

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
        start = self._situation(heldout.latent, heldout.a_h, operator)
        chunks = [(chunk, start.select(chunk)) for chunk in everyone.nonzero().flatten().split(CHUNK)]
        own = {id(chunk): [generators[i] for i in chunk.tolist()] for chunk, _ in chunks}
        draws = [self._draws(own[id(chunk)], part.operator, self.config.gate_rollouts, self.whole.horizon) for chunk, part in chunks]
        looks = [self._seen(part, drawn.steps(self.config.horizon)) for (_, part), drawn in zip(chunks, draws, strict=True)]
        cost = whole_cost = torch.cat([look.nominal.cost for look in looks])
        if self.config.variant == "no-rollout":
            whole = replace(self.imagination, config=self.whole.model_copy(update={"variant": "full"}))
            whole_cost = torch.cat([whole.nominal(part, drawn).cost for (_, part), drawn in zip(chunks, draws, strict=True)])
        signals = Signals(cost, whole_cost, cost_ahead)
        self.tau_c = signals.tau_c(self.config, self.tau_c)
        gains = [self._gain(part, look, generators, -torch.inf)[0].delta_g for (_, part), look in zip(chunks, looks, strict=True)]
        return signals.thresholds(self.tau_c, torch.cat(gains), self.config)

    def _winner(self, candidates: Batch, best: Tensor, look: Look) -> Plan:
        """Return the probe's winner as the plan; of the iterations of a search only the last stands for the probe."""
        won = candidates.take(best.unsqueeze(1))
        safe = torch.full((len(best), self.config.iterations), -1.0)
        safe[:, -1] = (candidates.returns.cost <= self.tau_c).sum(-1)
        predicted = Returns(*(values.squeeze(1) for values in won.returns))
        alone = look.nominal._replace(reward=look.baseline)
        return Plan(won.residuals.squeeze(1), torch.ones_like(best, dtype=torch.bool), safe, torch.zeros_like(safe) > 0, predicted, alone)

    def _gain(
        self, start: Situation, look: Look, generators: Sequence[np.random.Generator], tau_r: float
    ) -> tuple[Gain, Batch, Batch | None]:
        """Return what the best candidate gains (Eq. 11-12), the candidates, and the random sequences among them.

        A gain above tau_r is looked at again, where the configuration says so.
        """
        own = [generators[i] for i in start.rows.tolist()]
        sampled, candidates = None, look.taken
        if self.config.probe_with != "takeovers":
            sampled, baseline = self._sampled(start, look, own)
            candidates = sampled
            if self.config.probe_with == "both" and look.taken is not None:
                # Each beside the operator alone on its own rollouts.
                offset = (look.baseline - baseline).unsqueeze(1)
                beside = sampled._replace(returns=sampled.returns._replace(reward=sampled.returns.reward + offset))
                candidates, baseline = Batch.joined([beside, look.taken]), look.baseline
        else:
            baseline = look.baseline
        assert candidates is not None  # the configuration sees to it
        gain = probe(candidates, baseline, self.config, self.tau_c)
        again = (gain.delta_g > tau_r).nonzero().flatten()
        if self.config.rescore and len(again):
            fresh = self._draws([own[i] for i in again.tolist()], start.operator, self.config.gate_rollouts)
            part = Gain(gain.delta_g[again], gain.best[again])
            gain.delta_g[again] = scored_again(self.imagination, start.select(again), candidates.rows(again), part, fresh).delta_g
        return gain, candidates, sampled

    def _sampled(self, start: Situation, look: Look, own: Sequence[np.random.Generator]) -> tuple[Batch, Tensor]:
        """Return N_probe random sequences, evaluated, and the return [B] of the operator alone on the same rollouts."""
        forced = self.config.forced
        normals = normal(own, self.config.probe, *self.plan.shape[1:])
        kept = self._kept(start.rows) if self.config.probe_first else None
        candidates = propose(*self._start_distribution(start.rows), normals, kept, nothing=forced, centre=forced)
        returns = self.imagination.returns(start, candidates, look.draws.first(self.config.rollouts), alone=int(forced))
        return Batch(candidates, None, returns), returns.reward[:, 0] if forced else look.nominal.reward

    def _kept(self, rows: Tensor) -> Tensor | None:
        return self.kept[rows] if self.config.case2_memory else None

    def _plan(self, start: Situation, look: Look, generators: Sequence[np.random.Generator], first: Batch | None) -> Plan:
        """Search; candidates meet the gate's own draws, so that where it fired doing nothing is not suddenly safe."""
        own = [generators[i] for i in start.rows.tolist()]
        config = self.config
        normals = normal(own, config.iterations, config.candidates, *self.plan.shape[1:])
        mean, _ = self._start_distribution(start.rows)
        fresh = self._draws(own, start.operator, config.gate_rollouts) if config.finalists else None
        return plan_residuals(
            self.imagination, start, mean, normals, look.draws.first(config.rollouts), self.tau_c,
            first=first, besides=look.taken, fresh=fresh, kept=self._kept(start.rows),
        )  # fmt: skip

    def _rechecked(self, made: Plan) -> Plan:
        """Let the command stand where the gate had fired by chance, or little is saved, and the plan gains no more return than noise.

        By chance: on fresh rollouts the command alone is safe.
        """
        if not self.config.finalists:
            return made
        worth = made.predicted.reward - made.alone.reward > (torch.inf if self.config.variant == "safety-only" else self.tau_r)
        safe = (made.alone.cost <= self.tau_c) & self.config.recheck
        stands = (safe | (made.alone.cost - made.predicted.cost < self.config.least_saving)) & ~worth
        return made._replace(
            residuals=torch.where(stands.view(-1, 1, 1), 0.0, made.residuals),
            predicted=Returns(*(torch.where(stands, *fields) for fields in zip(made.alone, made.predicted, strict=True))),
        )

    def _start_distribution(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and std [B, L, A]: the last plan shifted by one with 0 appended where the last decision intervened, else 0."""
        warm = self.warm[rows] & self.config.warm_start
        mean = torch.where(warm.view(-1, 1, 1), shifted(self.plan[rows]), 0.0)
        return mean, torch.full_like(mean, self.config.initial_std)

    def _draws(self, generators: Sequence[np.random.Generator], operator: Operator, rollouts: int, horizon: int | None = None) -> Draws:
        horizon = horizon or self.config.horizon
        return Draws(
            gumbel(generators, horizon, rollouts, self.imagination.model.noise_size), uniform(generators, horizon, rollouts, operator.draws)
        )


def shifted(plan: Tensor) -> Tensor:
    """Return what is left of plans [B, L, A] one decision later, with 0 appended."""
    return torch.cat([plan[:, 1:], torch.zeros_like(plan[:, :1])], 1)
