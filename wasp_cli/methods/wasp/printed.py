"""WASP as printed: equations 7 to 18 of the paper, in the order of its section 4.

Where the section is open: reward and cost of step k are read at the state in which the step
arrives. An imagined episode that has ended pays and costs nothing more: gamma is multiplied by the
probability that it goes on. Each return has the discount of its critic. B decisions, N candidates,
M rollouts, H horizon, L residual steps, A actions, I iterations, K held-out decisions.
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
from wasp_cli.methods.wasp.returns import distributions, quantile, td_lambda
from wasp_cli.metrics.episode import CUT_OFF, GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.motors import UNKNOWN

ROLLOUTS, PROBE, SEARCH = range(3)  # what a decision draws for, each from a stream of its own
BOUND = 2.0  # largest residual, beyond which clipping (Eq. 18) leaves nothing else to gain.
TAU_C, TAU_R = 0.5, 0.5  # thresholds where no calibration exists yet
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
        self.config, self.imagination, self.device, self.noise = (
            config,
            imagination,
            device,
            DecisionNoise(device),
        )
        self.horizon, self.steps = (
            (1, 1) if config.variant == "no-rollout" else (config.horizon, config.residual_steps)
        )
        self.tau_c = (
            thresholds.get("tau_c", TAU_C) if config.tau_c == "calibrated" else float(config.tau_c)
        )
        self.tau_r = (
            thresholds.get("tau_r", TAU_R) if config.tau_r == "calibrated" else float(config.tau_r)
        )
        self.resting = torch.zeros(0, dtype=torch.bool)  # [B] the episode has ended
        # set where somebody waits: a search that it ends returns its best so far
        self.time_is_up: Callable[[], bool] = lambda: False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
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
        config, streams = self.config, self.noise.streams()
        here = chosen(~self.resting)
        start = Situation(latent, a_h, operator, torch.arange(len(a_h), device=a_h.device)).select(
            here
        )
        outcome = Outcome(a_h, UNKNOWN, config.iterations, self.steps)
        draws = Draws.of(
            streams,
            ROLLOUTS,
            start,
            self.horizon,
            config.rollouts,
            self.imagination.model.noise_size,
        )
        nominal = self.nominal(start, draws)

        # Safety-aware intervention function: active where the nominal cost return exceeds tau_c;
        # then the task-aware gate is skipped.
        active = nominal.cost[:, 0] > self.tau_c
        if config.variant == "task-only":
            active = torch.zeros_like(active)

        # Task-aware intervention function: active where Delta G_t > tau_r.
        delta_g = torch.full_like(nominal.reward[:, 0], torch.nan)
        silent = torch.zeros_like(active) if config.variant == "safety-only" else ~active
        rows = chosen(silent)
        if len(rows):
            gain = self.gain(start.select(rows), nominal.rows(rows), draws.rows(rows), streams)
            delta_g[rows] = torch.where(silent[rows], gain, torch.nan)
        gate = torch.where(active, GATE_SAFETY, GATE_TASK).to(torch.int8)
        outcome.saw(here, nominal.cost[:, 0], nominal.reward[:, 0], delta_g)

        # Model-predictive residual planning.
        planned = active | (delta_g > self.tau_r)
        rows = chosen(planned)
        if len(rows):
            outcome.carry_out(
                here[rows],
                planned[rows],
                gate[rows],
                self.plan(start.select(rows), nominal.rows(rows), draws.rows(rows), streams),
            )
        return outcome.decision()

    def nominal(self, start: Situation, draws: Draws) -> Scored:
        """Return what the operator alone leads to (Eq. 9-10); N = 1."""
        nothing = start.a_h.new_zeros(len(start.a_h), 1, self.steps, start.a_h.shape[1])
        return self._returns(start, nothing, draws, lambda k, command: command)

    def composed(self, start: Situation, residuals: Tensor, draws: Draws) -> Scored:
        """Return what candidates [B, N, L, A] lead to: a_{t+k} = a_t^H + delta_{t+k} for k < L,
        then a_{t+k}^H (Eq. 13).
        """
        size = max(1, ROWS // (residuals.shape[1] * draws.latent.shape[2]))
        chunks = torch.arange(len(residuals), device=residuals.device).split(size)
        return Scored.joined(
            [
                self._composed(start.select(rows), residuals[rows], draws.rows(rows))
                for rows in chunks
            ],
            along=0,
        )

    def _composed(self, start: Situation, residuals: Tensor, draws: Draws) -> Scored:
        delta = over_rollouts(residuals, draws.latent.shape[2])  # [R, L, A]
        now = start.a_h.repeat_interleave(len(delta) // len(start.a_h), 0)
        return self._returns(
            start,
            residuals,
            draws,
            lambda k, command: now + delta[:, k] if k < self.steps else command,
        )

    def _returns(
        self, start: Situation, residuals: Tensor, draws: Draws, compose: Compose
    ) -> Scored:
        """Summarise rollouts by TD-lambda returns with critics behind them (Eq. 7-8), as means
        over the M rollouts (Eq. 9, 10, 15).
        """
        imagined, models = (
            self.imagination.roll(start, residuals.shape[1], compose, draws),
            self.imagination,
        )
        goes_on = imagined.continues()
        reward = td_lambda(
            imagined.reward(), imagined.value_r(), models.gamma_r, models.lam, goes_on
        )
        cost = td_lambda(imagined.cost(), imagined.value_c(), models.gamma_c, models.lam, goes_on)
        return Scored(residuals, reward.mean(-1), cost.mean(-1))

    def gain(self, start: Situation, nominal: Scored, draws: Draws, streams: Streams) -> Tensor:
        """Return Delta G_t [B] (Eq. 12): what the best safe sequence of a probe (Eq. 11) gains;
        minus infinity where none is safe.
        """
        size = (self.config.probe, self.steps, start.a_h.shape[1])
        normals = streams.normal(*size, purpose=PROBE, rows=start.rows)
        probed = self.composed(
            start, (self.config.initial_std * normals).clamp(-BOUND, BOUND), draws
        )
        objective = torch.where(self.safe(probed), self.s_task(probed), -torch.inf)  # Eq. 11
        corrected = probed.take(objective.argmax(-1, keepdim=True))
        return torch.where(
            self.safe(probed).any(-1), (corrected.reward - nominal.reward).squeeze(1), -torch.inf
        )

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
        score = (candidates.cost - self.tau_c).clamp(
            min=0
        ) + self.config.alpha * candidates.residuals.square().sum((-1, -2))
        return score.nan_to_num(nan=torch.inf)

    def plan(self, start: Situation, nominal: Scored, draws: Draws, streams: Streams) -> Plan:
        """Search a residual sequence for B decisions by CEM, and select it (Eq. 18)."""
        config, only_case1 = self.config, self.config.variant == "no-case2"
        size = (config.iterations, config.candidates, self.steps, start.a_h.shape[1])
        normals = streams.normal(*size, purpose=SEARCH, rows=start.rows)
        mean, std = (
            torch.zeros_like(normals[:, 0, 0]),
            torch.full_like(normals[:, 0, 0], config.initial_std),
        )
        seen: list[Scored] = []
        safe_counts = normals.new_full((len(mean), config.iterations), CUT_OFF, dtype=torch.int16)
        for i in range(config.iterations):
            if i and self.time_is_up():
                break
            candidates = self.composed(
                start,
                (mean.unsqueeze(1) + std.unsqueeze(1) * normals[:, i]).clamp(-BOUND, BOUND),
                draws,
            )
            seen.append(candidates)
            count = self.safe(candidates).sum(-1, keepdim=True)
            safe_counts[:, i] = count.squeeze(1).to(torch.int16)

            # Case I, |F_s| >= N_f: the N_e safe candidates of highest S_task. Case II: the N_f
            # candidates of smallest S_safe.
            case1 = torch.where(self.safe(candidates), self.s_task(candidates), -torch.inf)
            score = (
                case1
                if only_case1
                else torch.where(count >= config.feasible, case1, -self.s_safe(candidates))
            )
            wanted = count.clamp(max=config.elites)
            if not only_case1:
                wanted = torch.where(count >= config.feasible, wanted, config.feasible)
            best = score.topk(min(max(config.elites, config.feasible), config.candidates), -1)
            # [B, .]
            elite = (
                torch.arange(best.indices.shape[1], device=score.device) < wanted
            ) & best.values.isfinite()
            mean, std = refitted(candidates.take(best.indices).residuals, elite, mean, std)

        # Eq. 18: the highest-scoring feasible candidate under S_task, otherwise the one of smallest
        # S_safe.
        every = Scored.joined(seen)
        task = torch.where(self.safe(every), self.s_task(every), -torch.inf)
        some = task.isfinite().any(-1)
        best_of_all = every.take(
            torch.where(some, task.argmax(-1), self.s_safe(every).argmin(-1)).unsqueeze(1)
        )
        # Without a defined score, or without Case II where nothing is safe, the command stands.
        stands = ~some & (self.s_safe(every).amin(-1).isinf() | only_case1)
        residuals = torch.where(stands.view(-1, 1, 1), 0.0, best_of_all.residuals.squeeze(1))
        alone = nominal.cost[:, 0], nominal.reward[:, 0]
        cost, reward = (
            torch.where(stands, alone[0], best_of_all.cost[:, 0]),
            torch.where(stands, alone[1], best_of_all.reward[:, 0]),
        )
        return Plan(
            residuals,
            cost,
            reward,
            *alone,
            safe_counts,
            (safe_counts >= 0) & (safe_counts < config.feasible),
        )

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Return tau_c and tau_r, which the paper does not give: quantiles of both gates' signals
        [K] under the unimpaired expert.

        tau_c is one of the nominal cost return over decisions after which nothing cost, tau_r one
        of Delta G_t where safety is silent.
        """
        config, count = self.config, len(heldout.a_h)
        self.reset(torch.ones(count, dtype=torch.bool), [seed + i for i in range(count)])
        streams = self.noise.streams()
        start = Situation(
            heldout.latent, heldout.a_h, operator, torch.arange(count, device=heldout.a_h.device)
        )
        draws = Draws.of(
            streams,
            ROLLOUTS,
            start,
            self.horizon,
            config.rollouts,
            self.imagination.model.noise_size,
        )
        nominal = self.nominal(start, draws)
        cost = nominal.cost[:, 0]
        free = cost[cost_ahead == 0]
        if config.tau_c == "calibrated" and len(free):
            self.tau_c = quantile(free, config.tau_c_quantile)
        gain = self.gain(start, nominal, draws, streams)
        quiet = gain[(cost <= self.tau_c) & gain.isfinite()]
        if config.tau_r == "calibrated" and len(quiet):
            self.tau_r = quantile(quiet, config.tau_r_quantile)
        spread = distributions(gain=quiet, g_cost=cost, g_cost_free=free)
        return {
            "tau_c": self.tau_c,
            "tau_r": self.tau_r,
            **spread,
            "safety_rate": float((cost > self.tau_c).float().mean()),
        }
