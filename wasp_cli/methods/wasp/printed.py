"""WASP as printed: equations 7 to 18 of the paper, in the order of its section 4.

Where the section is open, these readings are ours:

- Reward and cost of step k are read at the state in which the step arrives.
- An imagined episode that has ended pays and costs nothing more: gamma is multiplied by the
  probability that it goes on.
- Each return has the discount of its critic.

B decisions, N candidates, M rollouts, H horizon, L residual steps, A actions, I iterations, K
held-out decisions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import PrintedConfig
from wasp_cli.methods.noise import CPU, DecisionNoise, Streams
from wasp_cli.methods.quantiles import distributions, quantile
from wasp_cli.methods.record import chosen
from wasp_cli.methods.wasp.imagine import (
    Compose,
    Draws,
    Imagination,
    Scored,
    Situation,
    imagination_of,
    over_rollouts,
)
from wasp_cli.methods.wasp.outcome import Outcome, Plan, refitted
from wasp_cli.methods.wasp.returns import td_lambda
from wasp_cli.metrics.episode import CUT_OFF, GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.motors import UNKNOWN

# What a decision draws for, each from a stream of its own.
ROLLOUTS = 0
PROBE = 1
SEARCH = 2
BOUND = 2.0  # largest residual: clipping (Eq. 18) makes nothing of a larger one
# Thresholds where no calibration exists yet.
TAU_C = 0.5
TAU_R = 0.5
ROWS = 16384  # imagined rows at a time


def printed(config: Config, parts: Parts) -> Printed:
    """Build the printed WASP over the trained world model and critics."""
    return Printed(
        cast(PrintedConfig, config), imagination_of(parts), parts.thresholds, parts.device
    )


class Printed:
    """The assistant of section 4. Decisions of a batch are independent; each draws from its own
    episode's stream.
    """

    def __init__(
        self,
        config: PrintedConfig,
        imagination: Imagination,
        thresholds: Mapping[str, float],
        device: torch.device = CPU,
    ) -> None:
        self.config = config
        self.imagination = imagination
        self.device = device
        self.noise = DecisionNoise(device)

        single = config.variant == "no-rollout"
        self.horizon = 1 if single else config.horizon
        self.steps = 1 if single else config.residual_steps

        if config.tau_c == "calibrated":
            self.tau_c = thresholds.get("tau_c", TAU_C)
        else:
            self.tau_c = float(config.tau_c)
        if config.tau_r == "calibrated":
            self.tau_r = thresholds.get("tau_r", TAU_R)
        else:
            self.tau_r = float(config.tau_r)

        self.resting = torch.zeros(0, dtype=torch.bool)  # [B] the episode has ended
        # Set where a person waits: once it returns True, a search returns its best so far.
        self.time_is_up: Callable[[], bool] = lambda: False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        self.noise.reset(rows, seeds)
        if len(self.resting) != len(rows):
            self.resting = torch.zeros(len(rows), dtype=torch.bool, device=self.device)
        self.resting = self.resting & ~rows.to(self.device)

    def rest(self, rows: Tensor) -> None:
        """Decide nothing more in `rows` [B] (bool), whose episodes have ended; their commands
        stand.
        """
        self.resting = self.resting | rows.to(self.device)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Ask both intervention functions (section 4.2), and plan a residual where one is active
        (section 4.3).

        Args:
            latent: [B, .] (h_t, z_t), filtered.
            a_h: [B, A] a_t^H within the bounds.
            operator: pi_H, of B rows; it has just issued the commands.
        """
        config = self.config
        streams = self.noise.streams()
        here = chosen(~self.resting)  # indices [R] of the rows that are decided
        everyone = Situation(latent, a_h, operator, torch.arange(len(a_h), device=a_h.device))
        start = everyone.select(here)
        outcome = Outcome(a_h, UNKNOWN, config.iterations, self.steps)

        # Imagine nominal behaviour (Eq. 9-10).
        draws = self._draws(streams, start)
        nominal = self.nominal(start, draws)

        # Safety-aware intervention function: active where the nominal cost return exceeds tau_c;
        # then the task-aware gate is skipped.
        safety_active = nominal.cost[:, 0] > self.tau_c
        if config.variant == "task-only":
            safety_active = torch.zeros_like(safety_active)

        # Task-aware intervention function: active where Delta G_t > tau_r.
        probe = ~safety_active
        if config.variant == "safety-only":
            probe = torch.zeros_like(probe)
        delta_g = torch.full_like(nominal.reward[:, 0], torch.nan)
        rows = chosen(probe)
        if len(rows):
            gain = self.gain(start.select(rows), nominal.rows(rows), draws.rows(rows), streams)
            delta_g[rows] = torch.where(probe[rows], gain, torch.nan)
        outcome.saw(here, nominal.cost[:, 0], nominal.reward[:, 0], delta_g)

        # Model-predictive residual planning (section 4.3).
        active = safety_active | (delta_g > self.tau_r)
        gate = torch.where(safety_active, GATE_SAFETY, GATE_TASK).to(torch.int8)
        rows = chosen(active)
        if len(rows):
            plan = self.plan(start.select(rows), nominal.rows(rows), draws.rows(rows), streams)
            outcome.carry_out(here[rows], active[rows], gate[rows], plan)
        return outcome.decision()

    def _draws(self, streams: Streams, start: Situation) -> Draws:
        return Draws.of(
            streams,
            ROLLOUTS,
            start,
            self.horizon,
            self.config.rollouts,
            self.imagination.model.noise_size,
        )

    def nominal(self, start: Situation, draws: Draws) -> Scored:
        """Return what the operator alone leads to (Eq. 9-10); N = 1."""
        no_residual = start.a_h.new_zeros(len(start.a_h), 1, self.steps, start.a_h.shape[1])
        return self._returns(start, no_residual, draws, lambda k, command: command)

    def composed(self, start: Situation, residuals: Tensor, draws: Draws) -> Scored:
        """Return what candidates [B, N, L, A] lead to: a_{t+k} = a_t^H + delta_{t+k} for k < L,
        then a_{t+k}^H (Eq. 13).
        """
        # As many decisions at a time as fit into ROWS imagined rows.
        size = max(1, ROWS // (residuals.shape[1] * draws.latent.shape[2]))
        chunks = torch.arange(len(residuals), device=residuals.device).split(size)
        parts = [
            self._composed(start.select(rows), residuals[rows], draws.rows(rows)) for rows in chunks
        ]
        return Scored.joined(parts, along=0)

    def _composed(self, start: Situation, residuals: Tensor, draws: Draws) -> Scored:
        delta = over_rollouts(residuals, draws.latent.shape[2])  # [R, L, A]
        now = start.a_h.repeat_interleave(len(delta) // len(start.a_h), 0)  # [R, A] a_t^H

        def compose(k: int, command: Tensor) -> Tensor:
            if k < self.steps:
                return now + delta[:, k]
            return command

        return self._returns(start, residuals, draws, compose)

    def _returns(
        self, start: Situation, residuals: Tensor, draws: Draws, compose: Compose
    ) -> Scored:
        """Summarise rollouts by TD-lambda returns with critics behind them (Eq. 7-8), as means
        over the M rollouts (Eq. 9, 10, 15).
        """
        models = self.imagination
        imagined = models.roll(start, residuals.shape[1], compose, draws)
        keep = imagined.continues()
        reward = td_lambda(imagined.reward(), imagined.value_r(), models.gamma_r, models.lam, keep)
        cost = td_lambda(imagined.cost(), imagined.value_c(), models.gamma_c, models.lam, keep)
        return Scored(residuals, reward.mean(-1), cost.mean(-1))

    def gain(self, start: Situation, nominal: Scored, draws: Draws, streams: Streams) -> Tensor:
        """Return Delta G_t [B] (Eq. 12): what the best safe sequence of a probe (Eq. 11) gains;
        minus infinity where none is safe.
        """
        # Probe N_probe random sequences.
        size = (self.config.probe, self.steps, start.a_h.shape[1])
        normals = streams.normal(*size, purpose=PROBE, rows=start.rows)
        residuals = (self.config.initial_std * normals).clamp(-BOUND, BOUND)
        candidates = self.composed(start, residuals, draws)

        # The best safe one of them (Eq. 11), and what it gains (Eq. 12).
        safe = self.safe(candidates)
        objective = torch.where(safe, self.s_task(candidates), -torch.inf)
        corrected = candidates.take(objective.argmax(-1, keepdim=True))
        gain = (corrected.reward - nominal.reward).squeeze(1)
        return torch.where(safe.any(-1), gain, -torch.inf)

    def safe(self, candidates: Scored) -> Tensor:
        """Return F_s (Eq. 14) as a mask [B, N]."""
        return candidates.cost <= self.tau_c

    def s_task(self, candidates: Scored) -> Tensor:
        """Return S_task [B, N] (Eq. 16)."""
        effort = self.config.alpha * candidates.residuals.square().sum((-1, -2))
        score = candidates.reward / self.imagination.reward_unit - effort
        return score.nan_to_num(nan=-torch.inf)

    def s_safe(self, candidates: Scored) -> Tensor:
        """Return S_safe [B, N] (Eq. 17), to be minimised."""
        effort = self.config.alpha * candidates.residuals.square().sum((-1, -2))
        score = (candidates.cost - self.tau_c).clamp(min=0) + effort
        return score.nan_to_num(nan=torch.inf)

    def plan(self, start: Situation, nominal: Scored, draws: Draws, streams: Streams) -> Plan:
        """Search a residual sequence for B decisions by CEM, and select it (Eq. 18)."""
        config = self.config
        only_case1 = config.variant == "no-case2"
        size = (config.iterations, config.candidates, self.steps, start.a_h.shape[1])
        normals = streams.normal(*size, purpose=SEARCH, rows=start.rows)  # [B, I, N, L, A]

        # The distribution that is sampled, of residual sequences [B, L, A].
        mean = torch.zeros_like(normals[:, 0, 0])
        std = torch.full_like(mean, config.initial_std)

        batches: list[Scored] = []  # the candidates of every iteration
        safe_counts = normals.new_full((len(mean), config.iterations), CUT_OFF, dtype=torch.int16)
        for i in range(config.iterations):
            if i > 0 and self.time_is_up():
                break

            # Sample N residual sequences, and imagine what they lead to.
            residuals = mean.unsqueeze(1) + std.unsqueeze(1) * normals[:, i]
            candidates = self.composed(start, residuals.clamp(-BOUND, BOUND), draws)
            batches.append(candidates)
            safe = self.safe(candidates)
            count = safe.sum(-1, keepdim=True)  # [B, 1] |F_s|
            safe_counts[:, i] = count.squeeze(1).to(torch.int16)

            # Case I, |F_s| >= N_f: the elites are the N_e safe candidates of highest S_task. Case
            # II: they are the N_f candidates of smallest S_safe.
            by_task = torch.where(safe, self.s_task(candidates), -torch.inf)
            case1_elites = count.clamp(max=config.elites)
            if only_case1:
                score = by_task
                elite_count = case1_elites
            else:
                case1 = count >= config.feasible
                score = torch.where(case1, by_task, -self.s_safe(candidates))
                elite_count = torch.where(case1, case1_elites, config.feasible)

            # Refit the distribution to the elites. The same number of ranks is taken for all
            # decisions, and a mask leaves out those that are no elites.
            most = min(max(config.elites, config.feasible), config.candidates)
            best = score.topk(most, -1)
            places = torch.arange(most, device=score.device)
            is_elite = (places < elite_count) & best.values.isfinite()  # [B, most]
            elite_residuals = candidates.take(best.indices).residuals
            mean, std = refitted(elite_residuals, is_elite, mean, std)

        # Eq. 18: the highest-scoring feasible candidate of all iterations under S_task, otherwise
        # the one of smallest S_safe.
        everything = Scored.joined(batches)
        s_task = torch.where(self.safe(everything), self.s_task(everything), -torch.inf)
        s_safe = self.s_safe(everything)
        any_feasible = s_task.isfinite().any(-1)  # [B]
        index = torch.where(any_feasible, s_task.argmax(-1), s_safe.argmin(-1))
        selected = everything.take(index.unsqueeze(1))

        # Without a defined score, or without Case II where nothing is safe, the command stands.
        stands = ~any_feasible & (s_safe.amin(-1).isinf() | only_case1)
        residuals = torch.where(stands.view(-1, 1, 1), 0.0, selected.residuals.squeeze(1))
        alone_cost = nominal.cost[:, 0]
        alone_reward = nominal.reward[:, 0]
        return Plan(
            residuals=residuals,
            cost=torch.where(stands, alone_cost, selected.cost[:, 0]),
            reward=torch.where(stands, alone_reward, selected.reward[:, 0]),
            alone_cost=alone_cost,
            alone_reward=alone_reward,
            safe=safe_counts,
            case2=(safe_counts >= 0) & (safe_counts < config.feasible),
        )

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_c and tau_r, which the paper does not give, and return them with the
        distributions that they come from: both are quantiles of the gates' signals under the
        unimpaired expert.

        Args:
            heldout: K decisions of the expert.
            cost_ahead: [K] costly decisions among the W that begin with each; NaN where fewer are
                left in the episode.
            operator: unimpaired, one row per held-out decision.
            seed: names the draws.
        """
        config = self.config
        count = len(heldout.a_h)
        self.reset(torch.ones(count, dtype=torch.bool), [seed + i for i in range(count)])
        streams = self.noise.streams()
        everyone = torch.arange(count, device=heldout.a_h.device)
        start = Situation(heldout.latent, heldout.a_h, operator, everyone)
        draws = self._draws(streams, start)
        nominal = self.nominal(start, draws)

        # tau_c: of the nominal cost return, over decisions after which nothing cost.
        cost = nominal.cost[:, 0]  # [K]
        free_cost = cost[cost_ahead == 0]
        if config.tau_c == "calibrated" and len(free_cost):
            self.tau_c = quantile(free_cost, config.tau_c_quantile)

        # tau_r: of Delta G_t, over decisions at which the safety gate is silent.
        gain = self.gain(start, nominal, draws, streams)
        quiet_gain = gain[(cost <= self.tau_c) & gain.isfinite()]
        if config.tau_r == "calibrated" and len(quiet_gain):
            self.tau_r = quantile(quiet_gain, config.tau_r_quantile)

        spread = distributions({"gain": quiet_gain, "g_cost": cost, "g_cost_free": free_cost})
        return {
            "tau_c": self.tau_c,
            "tau_r": self.tau_r,
            **spread,
            "safety_rate": float((cost > self.tau_c).float().mean()),
        }
