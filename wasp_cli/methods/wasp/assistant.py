"""WASP: what does this command lead to, and what if it is corrected now?

The gates compare futures on common draws: the command, then the expert; and the correction, then
the expert. With `error_lasts` there is a third one: the command, then the expert with the
operator's error added, which is the command minus the expert's action. Nothing else of the operator
is imagined. The correction is the action closest to the command that has the force of the
expert's.

B decisions side by side, M rollouts of H steps, N candidates, L residual steps, A actions, K
held-out decisions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Heldout, Parts
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import CPU, DecisionNoise, Streams
from wasp_cli.methods.quantiles import distributions, quantile
from wasp_cli.methods.record import chosen
from wasp_cli.methods.wasp.adversary import Adversity, adversity_of
from wasp_cli.methods.wasp.imagine import (
    Draws,
    Imagination,
    Imagined,
    Scored,
    Situation,
    corrected,
    imagination_of,
)
from wasp_cli.methods.wasp.outcome import Outcome, Plan
from wasp_cli.methods.wasp.patience import Patience
from wasp_cli.methods.wasp.returns import discounted_sum, td_lambda
from wasp_cli.methods.wasp.search import search
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import DrawnNoise, Operator
from wasp_cli.tasks.motors import Motors

# What a decision draws for, each from a stream of its own.
GATES = 0
SEARCH = 1
FINALISTS = 2
# Thresholds that are to be calibrated, where no calibration exists yet.
TAU_C = 0.5
TAU_R = 0.1
MISTAKES = 4  # random commands for each held-out decision, from which tau_r comes
ERROR_LASTS = ("full", "safety-only", "no-case2")  # variants in which an error is imagined to last
CHUNK = 64  # held-out decisions that are imagined together


def wasp(config: Config, parts: Parts) -> WASP:
    """Build WASP over the trained world model and critics."""
    settings = cast(WASPConfig, config)
    imagination = imagination_of(parts)
    adversity = None
    if settings.adversary == "lucid":
        adversity = adversity_of(parts, imagination, settings.adversary_budget)
    return WASP(
        settings, imagination, parts.thresholds, parts.motors, parts.device, adversity=adversity
    )


class Look(NamedTuple):
    """The futures of B decisions that the gates compare."""

    target: Tensor  # [B, A] of the actions with the expert's force the one closest to the command
    futures: Scored  # N = 2: the command, then the expert; the correction, then the expert
    # [B] cost of the command, then the expert with the operator's error added; where no error is
    # imagined to last, that of the command, then the expert
    error_cost: Tensor
    draws: Draws  # of these rollouts

    @property
    def cost(self) -> Tensor:
        """Return what the command costs, [B] (Eq. 9): the cost of the costlier of the two futures
        that begin with it.
        """
        return torch.maximum(self.futures.cost[:, 0], self.error_cost)

    @property
    def gain(self) -> Tensor:
        """Return Delta G [B] (Eq. 12): what the correction gains."""
        return self.futures.reward[:, 1] - self.futures.reward[:, 0]

    @property
    def effective(self) -> Tensor:
        """Return where the correction has another force than the command: bool [B]."""
        return (self.futures.residuals[:, 1] != 0).any(-1).any(-1)

    def rows(self, index: Tensor) -> Look:
        """Select some of the decisions (indices [R])."""
        return Look(
            self.target[index],
            self.futures.rows(index),
            self.error_cost[index],
            self.draws.rows(index),
        )


class WASP:
    """The assistant. Decisions of a batch are independent; each draws from its own episode's
    stream.
    """

    def __init__(
        self,
        config: WASPConfig,
        imagination: Imagination,
        thresholds: Mapping[str, float],
        motors: Motors,
        device: torch.device = CPU,
        *,
        adversity: Adversity | None = None,
    ) -> None:
        self.config = config
        self.imagination = imagination
        self.adversity = adversity
        self.motors = motors
        self.device = device
        self.noise = DecisionNoise(device)

        # One imagined step, with both critics behind it.
        self.single = config.variant == "no-rollout"
        self.horizon = 1 if self.single else config.horizon
        self.steps = 1 if self.single else config.residual_steps
        # An error cannot last beyond a single step, and without a safety gate its cost is not read.
        self.error_lasts = config.error_lasts != 0.0 and config.variant in ERROR_LASTS

        if isinstance(config.tau_c, float | int) and not self.single:
            self.tau_c = float(config.tau_c)
        else:
            self.tau_c = thresholds.get("tau_c", TAU_C)
        if config.tau_r == "calibrated":
            self.tau_r = thresholds.get("tau_r", TAU_R)
        else:
            self.tau_r = float(config.tau_r)

        # [B, L, A] what the search chose at the last decision; zeros where nothing was searched
        self.plan = torch.zeros(0)
        self.resting = torch.zeros(0, dtype=torch.bool)  # [B] the episode has ended
        self.patience = Patience(self.horizon if config.patience == "horizon" else config.patience)
        # Set where a person waits: once it returns True, a search returns its best so far.
        self.time_is_up: Callable[[], bool] = lambda: False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        self.noise.reset(rows, seeds)
        batch = len(rows)
        action_size = self.imagination.model.action_size
        if self.plan.shape != (batch, self.steps, action_size):
            self.plan = torch.zeros((batch, self.steps, action_size), device=self.device)
            self.resting = torch.zeros(batch, dtype=torch.bool, device=self.device)
        rows = rows.to(self.device)
        # A plan never crosses the boundary of an episode.
        self.plan = torch.where(rows.view(-1, 1, 1), 0.0, self.plan)
        self.resting = self.resting & ~rows
        self.patience.reset(rows)

    def rest(self, rows: Tensor) -> None:
        """Decide nothing more in `rows` [B] (bool), whose episodes have ended; their commands
        stand.
        """
        self.resting = self.resting | rows.to(self.resting.device)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Ask both gates, and correct the commands where one fired.

        Args:
            latent: [B, .] filtered.
            a_h: [B, A] commands within the bounds.
            operator: of B rows; it has just issued them. It plays no part.
        """
        config = self.config
        streams = self.noise.streams()
        here = chosen(~self.resting)  # indices [R] of the rows that are decided
        start = self._situation(latent, a_h, here)
        outcome = Outcome(a_h, self.motors, config.iterations, self.steps)

        # Imagine what the command and its correction lead to (Eq. 9-10, 13).
        look = self._look(start, streams, error_lasts=self.error_lasts)
        command_cost = look.futures.cost[:, 0]
        correction_cost = look.futures.cost[:, 1]
        outcome.saw(here, look.cost, look.futures.reward[:, 0], look.gain)

        # Safety gate: the command costs more than tau_c (Eq. 9). Where it does so only if the
        # operator's error lasts, the correction has to cost less.
        correction_helps = (command_cost > self.tau_c) | (correction_cost < look.error_cost)
        safety_fired = (look.cost > self.tau_c) & correction_helps
        if config.variant == "task-only":
            safety_fired = torch.zeros_like(safety_fired)

        # Task gate: the safety gate is silent, and a safe correction gains tau_r (Eq. 11-12).
        correction_safe = correction_cost <= self.tau_c
        gains = look.effective & (look.gain > self.tau_r)
        task_fired = ~safety_fired & correction_safe & gains
        if config.variant == "safety-only":
            task_fired = torch.zeros_like(task_fired)

        # Execute a safe correction (Eq. 18), and one of an episode that has waited for too long.
        unsafe = safety_fired & ~correction_safe
        wait_is_over = unsafe & self.patience.is_over(here)
        gate = torch.where(safety_fired, GATE_SAFETY, GATE_TASK).to(torch.int8)
        by_correction = (safety_fired & correction_safe) | task_fired | wait_is_over
        correction = Plan.unsearched(look.futures, config.iterations)
        outcome.carry_out(here, by_correction, gate, correction)

        # Where the correction is not safe either, search (Eq. 13-17).
        by_search = unsafe & ~wait_is_over
        rows = chosen(by_search)  # indices [R'] among those of `here`
        plan = torch.zeros_like(self.plan)
        waits = torch.zeros_like(by_search)
        if len(rows):
            best = self._search(start.select(rows), look.rows(rows), streams)
            outcome.carry_out(here[rows], by_search[rows], gate[rows], best)
            plan[here[rows]] = torch.where(by_search[rows].view(-1, 1, 1), best.residuals, 0.0)
            # It waits at the expense of the task where the correction would gain tau_r.
            missed = look.futures.reward[rows, 1] - best.reward
            waits[rows] = by_search[rows] & (best.cost > self.tau_c) & (missed > self.tau_r)
        self.plan = plan
        self.patience.count(here, unsafe, waits)
        return outcome.decision()

    def _situation(self, latent: Latent, a_h: Tensor, here: Tensor) -> Situation:
        """Return where the decisions `here` (indices [R]) start: the expert goes on there."""
        nothing_drawn = DrawnNoise(a_h.new_zeros(0, 1, 0))
        expert = Operator(self.imagination.expert, a_h.shape[1], nothing_drawn, len(a_h))
        start = Situation(latent, a_h, expert, torch.arange(len(a_h), device=a_h.device))
        if len(here) == len(a_h):
            return start
        return start.select(here)

    def _look(self, start: Situation, streams: Streams, *, error_lasts: bool) -> Look:
        """Imagine the futures of B decisions; with `error_lasts` also the one in which the
        operator's error lasts.
        """
        draws = self._draws(streams, GATES, start)
        expert = self.imagination.expert(start.latent.features).clamp(-1, 1)  # [B, A]
        target = self.motors.least(start.a_h, expert)

        # The candidates: the command, the correction, and the command with an error that lasts.
        several = 3 if error_lasts else 2
        steps = self.horizon if error_lasts else self.steps
        residuals = start.a_h.new_zeros(len(target), several, steps, target.shape[1])
        residuals[:, 1, 0] = target - start.a_h
        if error_lasts:
            residuals[:, 2, 1:] = self._later_errors(start.a_h - expert)

        scored = self._scored(start, residuals, draws)
        futures = Scored(residuals[:, :2, : self.steps], scored.reward[:, :2], scored.cost[:, :2])
        error_cost = scored.cost[:, 2] if error_lasts else scored.cost[:, 0]
        return Look(target, futures, error_cost, draws)

    def _later_errors(self, error: Tensor) -> Tensor:
        """Return what is left of errors e [B, A] at the decisions after this one: rho^k e for
        k = 1..H-1, [B, H - 1, A], where rho is `error_lasts`.
        """
        steps = torch.arange(1, self.horizon, device=error.device)
        shares = self.config.error_lasts**steps
        return shares.view(1, -1, 1) * error.unsqueeze(1)

    def _scored(
        self, start: Situation, residuals: Tensor, draws: Draws, *, opposed: bool = True
    ) -> Scored:
        """Imagine candidates [B, N, L, A] and summarise them (Eq. 7-8): rewards with V_r behind
        the horizon, costs within it.

        With `opposed`, costs are those under the adversary where it raises them, if there is one.
        """
        compose = corrected(residuals, draws)
        imagined = self.imagination.roll(start, residuals.shape[1], compose, draws)
        models = self.imagination
        keep = imagined.continues()
        reward = td_lambda(imagined.reward(), imagined.value_r(), models.gamma_r, models.lam, keep)
        cost = self._cost_of(imagined)
        if self.adversity is not None and opposed:
            cost = self.adversity.raised(cost, start, compose, draws, self._cost_of)
        return Scored(residuals, reward.mean(-1), cost)

    def _cost_of(self, imagined: Imagined) -> Tensor:
        """Return G^(c) [B, N] of imagined candidates: means over their rollouts."""
        models = self.imagination
        keep = imagined.continues()
        if self.single:
            cost = td_lambda(imagined.cost(), imagined.value_c(), models.gamma_c, models.lam, keep)
        else:
            cost = discounted_sum(imagined.cost(), models.gamma_c, keep)
        return cost.mean(-1)

    def _search(self, start: Situation, look: Look, streams: Streams) -> Plan:
        """Search a plan for B decisions, from what the gates saw of them."""
        config = self.config
        size = (config.iterations, config.candidates, self.steps, start.a_h.shape[1])
        normals = streams.normal(*size, purpose=SEARCH, rows=start.rows)
        gate_draws = look.draws.first(config.search_rollouts)
        fresh_draws = self._draws(streams, FINALISTS, start)

        # Proposals: the correction, and the last plan one step later.
        last = self.plan[start.rows]  # [B, L, A]
        shifted = torch.cat([last[:, 1:], torch.zeros_like(last[:, :1])], 1)
        proposals = torch.stack([look.futures.residuals[:, 1], shifted], 1)
        first = start.rows.new_zeros(len(last), 1)  # index of the command among the futures

        def score(residuals: Tensor) -> Scored:
            return self._scored(start, residuals, gate_draws, opposed=False)

        def rescore(residuals: Tensor) -> Scored:
            return self._scored(start, residuals, fresh_draws)

        return search(
            score,
            rescore,
            proposals,
            normals,
            look.futures.take(first),
            config,
            self.tau_c,
            torch.inf if config.variant == "safety-only" else self.tau_r,
            self.time_is_up,
            self.imagination.reward_unit,
        )

    def _draws(self, streams: Streams, purpose: int, start: Situation) -> Draws:
        return Draws.of(
            streams,
            purpose,
            start,
            self.horizon,
            self.config.rollouts,
            self.imagination.model.noise_size,
        )

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set tau_c and tau_r, and return them with the distributions that they come from.

        tau_r is what it gains on average to put a random command right, at decisions of the
        unimpaired expert from which both futures are safe: smaller gains are those of commands that
        are no worse than most. It follows a task's scale of rewards, and depends on no operator.

        Args:
            heldout: K decisions of the expert.
            cost_ahead: [K] costly decisions among the W that begin with each; NaN where fewer are
                left in the episode.
            operator: not read.
            seed: names the draws.
        """
        config = self.config

        # tau_c: a quantile of what the expert's commands cost where nothing cost afterwards.
        cost = self._everywhere(heldout, heldout.a_h, seed).futures.cost[:, 0]  # [K]
        free_cost = cost[cost_ahead == 0]
        if self.single:
            # The cost of one step has another unit. Its tau_c lets through as many of the expert's
            # decisions as that of the whole method.
            whole = WASP(
                config.model_copy(update={"variant": "full"}),
                self.imagination,
                {},
                self.motors,
                self.device,
                adversity=self.adversity,
            )
            rate = whole.calibrate(heldout, cost_ahead, operator, seed)["safety_rate"]
            self.tau_c = quantile(cost, 1.0 - rate)
        elif config.tau_c == "calibrated":
            self.tau_c = quantile(free_cost, config.tau_c_quantile) if len(free_cost) else TAU_C

        # tau_r: a share of what corrections of random commands gain.
        random = np.random.default_rng(seed)
        gains = []
        for k in range(MISTAKES):
            uniform = random.uniform(-1, 1, tuple(heldout.a_h.shape)).astype(np.float32)
            commands = torch.from_numpy(uniform).to(self.device)  # [K, A]
            look = self._everywhere(heldout, commands, seed + k)
            both_safe = (look.futures.cost <= self.tau_c).all(-1)
            gains.append(look.gain[look.effective & both_safe])
        gain = torch.cat(gains)
        if config.tau_r == "calibrated":
            self.tau_r = config.tau_r_share * float(gain.mean()) if len(gain) else TAU_R

        spread = distributions({"gain": gain, "g_cost": cost, "g_cost_free": free_cost})
        return {
            "tau_c": self.tau_c,
            "tau_r": self.tau_r,
            **spread,
            "safety_rate": float((cost > self.tau_c).float().mean()),
        }

    def _everywhere(self, heldout: Heldout, a_h: Tensor, seed: int) -> Look:
        """Look at all held-out decisions under commands [K, A]; `draws` are those of the first
        CHUNK of them.
        """
        count = len(a_h)
        self.reset(torch.ones(count, dtype=torch.bool), [seed + i for i in range(count)])
        streams = self.noise.streams()
        everyone = torch.arange(count, device=a_h.device)
        start = self._situation(heldout.latent, a_h, everyone)
        # Single decisions have no history of errors, and the expert's own commands have none.
        looks = [
            self._look(start.select(rows), streams, error_lasts=False)
            for rows in everyone.split(CHUNK)
        ]
        return Look(
            target=torch.cat([look.target for look in looks]),
            futures=Scored.joined([look.futures for look in looks], along=0),
            error_cost=torch.cat([look.error_cost for look in looks]),
            draws=looks[0].draws,
        )
