"""WASP: model-predictive intervention (section 4.2), then model-predictive residual planning (section 4.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.errors import WaspError
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import CPU, DecisionNoise, Streams, as_gumbel
from wasp_cli.methods.record import chosen
from wasp_cli.methods.wasp.candidates import Batch, none_taken, propose, takeovers
from wasp_cli.methods.wasp.gates import Gain, Signals, probe, resolved_tau_c, resolved_tau_r, safety_gate, scored_again
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.methods.wasp.operator_model import imagined_operator, load_clone
from wasp_cli.methods.wasp.outcome import Outcome
from wasp_cli.methods.wasp.planner import Plan, plan_residuals
from wasp_cli.methods.wasp.witness import Witness, load_witness
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Operator
from wasp_cli.operators.cloned import ClonedOperator

GATE, PROBE, RESCORE, SEARCH, FINALISTS = range(5)
"""What a decision draws for, each from a stream of its own."""
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
    critics = load_module(LatentCritics, parts.inputs["critics"] / "critics.safetensors").to(parts.device)
    whole = cast(WASPConfig, config)
    config = effective(whole)
    imagination = Imagination(
        parts.world_model, critics, config, parts.gamma_r, parts.gamma_c, parts.lam, expert=parts.skills.expert
    )  # fmt: skip
    witness = None if config.witness == "sum" else load_witness(config, parts.inputs["lookahead"], parts.device)
    clone = None
    if config.operator_model == "cloned":
        clone = load_clone(parts.inputs["clone"], parts.skills.expert, parts.world_model.action_size, parts.device)
    return WASP(whole, imagination, parts.thresholds, witness, clone, parts.device)


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
        device: torch.device = CPU,
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
        self.noise, self.device = DecisionNoise(device), device
        self.plan = torch.zeros(0)  # [B, L, A] of the last decision
        self.warm = torch.zeros(0, dtype=torch.bool)  # [B] it intervened
        self.kept = torch.zeros(0)  # [B, L, A] what Case II chose last, shifted to now
        self.kept_for = torch.zeros(0, dtype=torch.long)  # [B] decisions for which it stays a candidate
        self.exceeded = torch.zeros(0, dtype=torch.bool)  # [B] the nominal cost return exceeded tau_c at the last decision
        self.resting = torch.zeros(0, dtype=torch.bool)  # [B] the episode has ended
        self.time_is_up: Callable[[], bool] | None = None  # set where somebody waits: a search that it ends returns its best so far

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        size = (len(rows), self.config.residual_steps, self.imagination.model.action_size)
        if self.plan.shape != size:
            self.plan = self.kept = torch.zeros(size, device=self.device)
            self.warm = self.exceeded = self.resting = torch.zeros(len(rows), dtype=torch.bool, device=self.device)
            self.kept_for = torch.zeros(len(rows), dtype=torch.long, device=self.device)
        rows = rows.to(self.device)
        # A plan never crosses the boundary of an episode.
        self.plan = torch.where(rows.view(-1, 1, 1), 0.0, self.plan)
        self.kept = torch.where(rows.view(-1, 1, 1), 0.0, self.kept)
        self.warm, self.kept_for = self.warm & ~rows, torch.where(rows, 0, self.kept_for)
        self.exceeded, self.resting = self.exceeded & ~rows, self.resting & ~rows

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Ask both gates, and plan a correction for the decisions where one fired.

        Args:
            latent: [B, .] filtered.
            a_h: [B, A] commands within the bounds.
            operator: of B rows; it has just issued them.
        """
        # Begin with the commands of the episodes that go on: no gate fired, nothing is planned.
        streams = self.noise.streams()
        here = chosen(~self.resting)
        whole = self._situation(latent, a_h, operator)
        start = whole if len(here) == len(a_h) else whole.select(here)
        outcome = Outcome.standing(start.a_h, self.config)

        # Imagine the operator alone, G^(c) and G^(r) of the nominal rollouts (Eq. 9-10), and beside it the takeovers.
        look = self._look(start, streams)

        # Safety gate: fires where the nominal cost return exceeds tau_c (Eq. 9).
        fired = safety_gate(look.nominal, self.config, self.tau_c, look.foreseen, self.exceeded[here])
        searched = fired
        if look.taken is not None and not self.config.safety_search:
            # Without a search where the expert's takeover is safe.
            known = fired & (look.taken.returns.cost <= self.tau_c).any(-1)
            searched = fired & ~known
            if len(rows := chosen(known)):
                part = look.rows(rows)
                assert part.taken is not None
                best = probe(part.taken, part.baseline, self.config, self.tau_c).best
                outcome.carry_out(rows, known[rows], GATE_SAFETY, self._winner(part.taken, best, part))

        # Task gate, where the safety gate is silent: the best safe candidate must gain more return than tau_r (Eq. 11-12).
        silent = ~fired if self.config.variant != "safety-only" else torch.zeros_like(fired)
        if len(rows := chosen(silent)):
            asked = look.rows(rows)
            gain, candidates, sampled = self._gain(start.select(rows), asked, streams, self.tau_r)
            outcome.record.delta_g[rows] = torch.where(silent[rows], gain.delta_g, torch.nan).to(torch.float32)
            worth = silent[rows] & (gain.delta_g > self.tau_r)
            some = chosen(worth)
            which, gated = rows[some], worth[some]
            if not self.config.task_search:
                if len(some):
                    won = self._winner(candidates.rows(some), gain.best[some], asked.rows(some))
                    outcome.carry_out(which, gated, GATE_TASK, won)
            elif sampled is not None and self.config.probe_first:
                if len(some):  # random sequences that fired are the first iteration, so that this search is one of its own
                    made = self._plan(start.select(which), look.rows(which), streams, sampled.rows(some))
                    outcome.carry_out(which, gated, GATE_TASK, made)
            else:
                searched = searched.index_put((which,), gated | searched[which])

        # Where a gate fired, search (Eq. 13-17); after the safety gate look again whether the command needs it.
        if len(rows := chosen(searched)):
            made = self._rechecked(self._plan(start.select(rows), look.rows(rows), streams, None), fired[rows])
            outcome.carry_out(rows, searched[rows], torch.where(fired[rows], GATE_SAFETY, GATE_TASK).to(torch.int8), made)

        # Keep the plans as the next decision's starting point.
        exceeded = look.nominal.cost > self.tau_c
        outcome.record = outcome.record._replace(g_cost=look.nominal.cost, g_return=look.nominal.reward)
        if start is not whole:
            outcome, exceeded = outcome.among(here, a_h, self.config), torch.zeros_like(self.exceeded).index_put((here,), exceeded)
        self.exceeded = exceeded
        self._remember(outcome.plan, outcome.warm, outcome.recovering)
        return Decision(outcome.action, outcome.record, outcome.planned)

    def rest(self, rows: Tensor) -> None:
        """Decide nothing more in `rows` [B] (bool), whose episodes have ended; their commands stand."""
        self.resting = self.resting | rows.to(self.resting.device)

    def nominal(self, latent: Latent, a_h: Tensor, operator: Operator) -> Returns:
        """Return what the operator alone leads to (Eq. 9-10), [B] each, at the cost of a decision in which nothing else is imagined."""
        return self._look(self._situation(latent, a_h, operator), self.noise.streams()).nominal

    def foreseen_cost(self, latent: Latent, a_h: Tensor, operator: Operator) -> Tensor:
        """Return what the safety gate reads [B] (Eq. 9), with the draws of a decision, and nothing else imagined."""
        start = self._situation(latent, a_h, operator)
        return self.imagination.nominal(start, self._draws(self.noise.streams(), GATE, start)).cost

    def _situation(self, latent: Latent, a_h: Tensor, operator: Operator) -> Situation:
        imagined = imagined_operator(self.config.operator_model, operator, a_h, self.imagination.expert, self.clone)
        return Situation(latent, a_h, imagined, torch.arange(len(a_h), device=a_h.device))

    def _look(self, start: Situation, streams: Streams) -> Look:
        return self._seen(start, self._draws(streams, GATE, start))

    def _seen(self, start: Situation, draws: Draws) -> Look:
        batch, actions = start.a_h.shape
        share = takeovers(self.config, batch).to(start.a_h.device)
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
        met = torch.arange(several * each, device=share.device)
        index = torch.cat([met.view(several, each), met[:each].expand(share.shape[1], -1)])
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
        streams = self.noise.streams()
        start = self._situation(heldout.latent, heldout.a_h, operator)
        chunks = [start.select(chunk) for chunk in start.rows.split(CHUNK)]
        draws = [self._draws(streams, GATE, part, self.whole.horizon) for part in chunks]
        looks = [self._seen(part, drawn.steps(self.config.horizon)) for part, drawn in zip(chunks, draws, strict=True)]
        cost = whole_cost = torch.cat([look.nominal.cost for look in looks])
        if self.config.variant == "no-rollout":
            whole = replace(self.imagination, config=self.whole.model_copy(update={"variant": "full"}))
            whole_cost = torch.cat([whole.nominal(part, drawn).cost for part, drawn in zip(chunks, draws, strict=True)])
        signals = Signals(cost, whole_cost, cost_ahead)
        self.tau_c = signals.tau_c(self.config, self.tau_c)
        gains = [self._gain(part, look, streams, -torch.inf)[0].delta_g for part, look in zip(chunks, looks, strict=True)]
        return signals.thresholds(self.tau_c, torch.cat(gains), self.config)

    def _winner(self, candidates: Batch, best: Tensor, look: Look) -> Plan:
        """Return the probe's winner as the plan; of the iterations of a search only the last stands for the probe."""
        won = candidates.take(best.unsqueeze(1))
        safe = torch.full((len(best), self.config.iterations), -1.0, device=best.device)
        safe[:, -1] = (candidates.returns.cost <= self.tau_c).sum(-1)
        predicted = Returns(*(values.squeeze(1) for values in won.returns))
        alone = look.nominal._replace(reward=look.baseline)
        return Plan(won.residuals.squeeze(1), torch.ones_like(best, dtype=torch.bool), safe, torch.zeros_like(safe) > 0, predicted, alone)

    def _gain(self, start: Situation, look: Look, streams: Streams, tau_r: float) -> tuple[Gain, Batch, Batch | None]:
        """Return what the best candidate gains (Eq. 11-12), the candidates, and the random sequences among them.

        A gain above tau_r is looked at again, where the configuration says so.
        """
        sampled, candidates = None, look.taken
        if self.config.probe_with != "takeovers":
            sampled, baseline = self._sampled(start, look, streams)
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
        promising = gain.delta_g > tau_r
        again = chosen(promising)
        if self.config.rescore and len(again):
            some, part = start.select(again), Gain(gain.delta_g[again], gain.best[again])
            scored = scored_again(self.imagination, some, candidates.rows(again), part, self._draws(streams, RESCORE, some)).delta_g
            gain.delta_g[again] = torch.where(promising[again], scored, gain.delta_g[again])
        return gain, candidates, sampled

    def _sampled(self, start: Situation, look: Look, streams: Streams) -> tuple[Batch, Tensor]:
        """Return N_probe random sequences, evaluated, and the return [B] of the operator alone on the same rollouts."""
        forced = self.config.forced
        normals = streams.normal(self.config.probe, *self.plan.shape[1:], purpose=PROBE, rows=start.rows)
        kept = self._kept(start.rows) if self.config.probe_first else None
        candidates = propose(*self._start_distribution(start.rows), normals, kept, nothing=forced, centre=forced)
        returns = self.imagination.returns(start, candidates, look.draws.first(self.config.rollouts), alone=int(forced))
        return Batch(candidates, None, returns), returns.reward[:, 0] if forced else look.nominal.reward

    def _kept(self, rows: Tensor) -> Tensor | None:
        return self.kept[rows] if self.config.case2_memory else None

    def _plan(self, start: Situation, look: Look, streams: Streams, first: Batch | None) -> Plan:
        """Search; candidates meet the gate's own draws, so that where it fired doing nothing is not suddenly safe."""
        config = self.config
        normals = streams.normal(config.iterations, config.candidates, *self.plan.shape[1:], purpose=SEARCH, rows=start.rows)
        mean, _ = self._start_distribution(start.rows)
        fresh = self._draws(streams, FINALISTS, start) if config.finalists else None
        return plan_residuals(
            self.imagination, start, mean, normals, look.draws.first(config.rollouts), self.tau_c,
            first=first, besides=look.taken, fresh=fresh, kept=self._kept(start.rows),
            time_is_up=self.time_is_up, gate=look.nominal._replace(reward=look.baseline),
        )  # fmt: skip

    def _rechecked(self, made: Plan, fired: Tensor) -> Plan:
        """Let the command stand where the safety gate had fired [R] by chance: it is safe on fresh rollouts, and the plan gains nothing."""
        if not self.config.finalists:
            return made
        worth = made.predicted.reward - made.alone.reward > (torch.inf if self.config.variant == "safety-only" else self.tau_r)
        safe = (made.alone.cost <= self.tau_c) & self.config.recheck
        stands = safe & ~worth & fired
        return made._replace(
            residuals=torch.where(stands.view(-1, 1, 1), 0.0, made.residuals),
            predicted=Returns(*(torch.where(stands, *fields) for fields in zip(made.alone, made.predicted, strict=True))),
        )

    def _start_distribution(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and std [B, L, A]: the last plan shifted by one with 0 appended where the last decision intervened, else 0."""
        warm = self.warm[rows] & self.config.warm_start
        mean = torch.where(warm.view(-1, 1, 1), shifted(self.plan[rows]), 0.0)
        return mean, torch.full_like(mean, self.config.initial_std)

    def _draws(self, streams: Streams, purpose: int, start: Situation, horizon: int | None = None) -> Draws:
        size = (horizon or self.config.horizon, self.config.gate_rollouts)
        shapes = (*size, self.imagination.model.noise_size), (*size, start.operator.draws)
        latents, commands = streams.uniform(*shapes, purpose=purpose, rows=start.rows)
        return Draws(as_gumbel(latents), commands)


def shifted(plan: Tensor) -> Tensor:
    """Return what is left of plans [B, L, A] one decision later, with 0 appended."""
    return torch.cat([plan[:, 1:], torch.zeros_like(plan[:, :1])], 1)
