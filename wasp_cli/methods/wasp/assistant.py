"""WASP: what happens if you keep doing this, and what if it is corrected now?

The gates compare three futures on common draws: the command, then the expert; the best correction
now, then the expert; and, with `error_lasts`, the command, then the expert with the operator's
error, which is the command minus the expert's action. Nothing else of the operator is imagined. The
correction is the least one of its force. B decisions side by side, M rollouts of H steps, N
candidates, L residual steps, A actions, K held-out decisions.
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
from wasp_cli.methods.wasp.returns import discounted_sum, distributions, quantile, td_lambda
from wasp_cli.methods.wasp.search import search
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import DrawnNoise, Operator
from wasp_cli.tasks.motors import Motors

GATES, SEARCH, FINALISTS = range(3)  # what a decision draws for, each from a stream of its own
TAU_C, TAU_R = 0.5, 0.1  # thresholds that are to be calibrated, where no calibration exists yet
MISTAKES = 4  # random commands for each held-out decision, from which tau_r comes
LOOKING_ON = ("full", "safety-only", "no-case2")  # variants in which an error is imagined to last
CHUNK = 64  # held-out decisions that are looked at together


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

    target: Tensor  # [B, A] the least action of the expert's force
    futures: Scored  # N = 2: the command, then the expert; the correction, then the expert
    lasting: Tensor  # [B] cost of the command, then the expert with the operator's error
    draws: Draws  # of these rollouts

    @property
    def cost(self) -> Tensor:
        """Return what the command costs, [B] (Eq. 9): the more of the two futures that begin with
        it.
        """
        return torch.maximum(self.futures.cost[:, 0], self.lasting)

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
            self.lasting[index],
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

        # one imagined step, and both critics behind it
        self.single = config.variant == "no-rollout"
        self.horizon = 1 if self.single else config.horizon
        self.steps = 1 if self.single else config.residual_steps
        # Behind a single step no error can go on, and without a safety gate nobody asks.
        self.looks_on = config.error_lasts != 0.0 and config.variant in LOOKING_ON

        given = isinstance(config.tau_c, float | int) and not self.single
        self.tau_c = float(config.tau_c) if given else thresholds.get("tau_c", TAU_C)
        if config.tau_r == "calibrated":
            self.tau_r = thresholds.get("tau_r", TAU_R)
        else:
            self.tau_r = float(config.tau_r)

        # [B, L, A] what the search chose at the last decision; zeros where it was not asked
        self.plan = torch.zeros(0)
        self.resting = torch.zeros(0, dtype=torch.bool)  # [B] the episode has ended
        self.patience = Patience(self.horizon if config.patience == "horizon" else config.patience)
        # set where somebody waits: a search that it ends returns its best so far
        self.time_is_up: Callable[[], bool] = lambda: False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        batch = len(rows)
        action_size = self.imagination.model.action_size
        if self.plan.shape != (batch, self.steps, action_size):
            self.plan = torch.zeros((batch, self.steps, action_size), device=self.device)
            self.resting = torch.zeros(batch, dtype=torch.bool, device=self.device)
        rows = rows.to(self.device)
        # a plan never crosses the boundary of an episode
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
            operator: of B rows; it has just issued them, and plays no part.
        """
        config = self.config
        streams = self.noise.streams()
        here = chosen(~self.resting)
        start = self._situation(latent, a_h, here)
        outcome = Outcome(a_h, self.motors, config.iterations, self.steps)

        # Imagine what the command and its correction lead to (Eq. 9-10, 13).
        look = self._look(start, streams, looks_on=self.looks_on)
        once, corrected_cost = look.futures.cost.unbind(1)
        outcome.saw(here, look.cost, look.futures.reward[:, 0], look.gain)

        # Safety gate: the command costs more than tau_c (Eq. 9). Where it does so only if the
        # operator's error goes on, the correction has to cost less.
        fired = (look.cost > self.tau_c) & ((once > self.tau_c) | (corrected_cost < look.lasting))
        if config.variant == "task-only":
            fired = torch.zeros_like(fired)

        # Task gate: the safety gate is silent, and a safe correction gains tau_r (Eq. 11-12).
        safe = corrected_cost <= self.tau_c
        worth = ~fired & safe & look.effective & (look.gain > self.tau_r)
        if config.variant == "safety-only":
            worth = torch.zeros_like(worth)
        gate = torch.where(fired, GATE_SAFETY, GATE_TASK).to(torch.int8)

        # Where the expert's action is not safe either, search (Eq. 13-17), unless this episode has
        # waited for too long.
        unsafe = fired & ~safe
        goes_on = unsafe & self.patience.is_over(here)
        sought = unsafe & ~goes_on
        outcome.carry_out(
            here,
            (fired & safe) | worth | goes_on,
            gate,
            Plan.unsearched(look.futures, config.iterations),
        )
        rows = chosen(sought)
        plan = torch.zeros_like(self.plan)
        held = torch.zeros_like(sought)
        if len(rows):
            made = self._search(start.select(rows), look.rows(rows), streams)
            outcome.carry_out(here[rows], sought[rows], gate[rows], made)
            plan[here[rows]] = torch.where(sought[rows].view(-1, 1, 1), made.residuals, 0.0)
            # It waits at the expense of the task where the expert's action would gain tau_r.
            missed = look.futures.reward[rows, 1] - made.reward
            held[rows] = sought[rows] & (made.cost > self.tau_c) & (missed > self.tau_r)
        self.plan = plan
        self.patience.count(here, unsafe, held)
        return outcome.decision()

    def _situation(self, latent: Latent, a_h: Tensor, here: Tensor) -> Situation:
        expert = Operator(
            self.imagination.expert, a_h.shape[1], DrawnNoise(a_h.new_zeros(0, 1, 0)), len(a_h)
        )
        start = Situation(latent, a_h, expert, torch.arange(len(a_h), device=a_h.device))
        return start if len(here) == len(a_h) else start.select(here)

    def _look(self, start: Situation, streams: Streams, *, looks_on: bool) -> Look:
        """Imagine the futures of B decisions; with `looks_on` also that of an error that lasts."""
        draws = self._draws(streams, GATES, start)
        expert = self.imagination.expert(start.latent.features).clamp(-1, 1)
        target = self.motors.least(start.a_h, expert)
        steps = self.horizon if looks_on else self.steps
        residuals = start.a_h.new_zeros(len(target), 3 if looks_on else 2, steps, target.shape[1])
        residuals[:, 1, 0] = target - start.a_h
        if looks_on:
            residuals[:, 2, 1:] = self._goes_on(start.a_h - expert)
        scored = self._scored(start, residuals, draws)
        futures = Scored(residuals[:, :2, : self.steps], scored.reward[:, :2], scored.cost[:, :2])
        return Look(target, futures, scored.cost[:, -1 if looks_on else 0], draws)

    def _goes_on(self, error: Tensor) -> Tensor:
        """Return what is left of errors e [B, A] at the decisions behind this one: rho^k e,
        [B, H - 1, A].
        """
        steps = torch.arange(1, self.horizon, device=error.device)
        left = self.config.error_lasts**steps
        return left.view(1, -1, 1) * error.unsqueeze(1)

    def _scored(
        self, start: Situation, residuals: Tensor, draws: Draws, *, opposed: bool = True
    ) -> Scored:
        """Imagine candidates [B, N, L, A] and summarise them (Eq. 7-8): rewards with V_r behind
        the horizon, costs within it; these also under the adversary, where there is one and
        `opposed` asks for it.
        """
        compose = corrected(residuals, draws)
        imagined = self.imagination.roll(start, residuals.shape[1], compose, draws)
        models, keep = self.imagination, imagined.continues()
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
        config = self.config
        size = (config.iterations, config.candidates, self.steps, start.a_h.shape[1])
        normals = streams.normal(*size, purpose=SEARCH, rows=start.rows)
        fresh = self._draws(streams, FINALISTS, start)
        few = look.draws.first(config.search_rollouts)
        last = self.plan[start.rows]
        shifted = torch.cat([last[:, 1:], torch.zeros_like(last[:, :1])], 1)
        return search(
            lambda residuals: self._scored(start, residuals, few, opposed=False),
            lambda residuals: self._scored(start, residuals, fresh),
            torch.stack([look.futures.residuals[:, 1], shifted], 1),
            normals,
            look.futures.take(start.rows.new_zeros(len(last), 1)),
            config,
            self.tau_c,
            self.tau_r if config.variant != "safety-only" else torch.inf,
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
        """Return tau_c and tau_r, and the distributions that they stand in, from K held-out
        decisions and their costs ahead [K].

        tau_r is what putting right a random command gains on average, at decisions of the
        unimpaired expert from which both futures are safe: smaller gains are those of commands that
        are no worse than most. It follows a task's scale of rewards, and knows no operator.
        """
        cost = self._everywhere(heldout, heldout.a_h, seed).futures.cost[:, 0]  # [K]
        free = cost[cost_ahead == 0]
        if self.single:
            # In the unit of one step: it lets through as many of the expert's decisions as the
            # whole method.
            whole = WASP(
                self.config.model_copy(update={"variant": "full"}),
                self.imagination,
                {},
                self.motors,
                self.device,
                adversity=self.adversity,
            )
            rate = whole.calibrate(heldout, cost_ahead, operator, seed)["safety_rate"]
            self.tau_c = quantile(cost, 1.0 - rate)
        elif self.config.tau_c == "calibrated":
            self.tau_c = quantile(free, self.config.tau_c_quantile) if len(free) else TAU_C
        random = np.random.default_rng(seed)
        gains = []
        for k in range(MISTAKES):
            mistakes = torch.from_numpy(
                random.uniform(-1, 1, tuple(heldout.a_h.shape)).astype(np.float32)
            ).to(self.device)
            look = self._everywhere(heldout, mistakes, seed + k)
            gains.append(look.gain[look.effective & (look.futures.cost <= self.tau_c).all(-1)])
        gain = torch.cat(gains)
        if self.config.tau_r == "calibrated":
            self.tau_r = self.config.tau_r_share * float(gain.mean()) if len(gain) else TAU_R
        spread = distributions(gain=gain, g_cost=cost, g_cost_free=free)
        return {
            "tau_c": self.tau_c,
            "tau_r": self.tau_r,
            **spread,
            "safety_rate": float((cost > self.tau_c).float().mean()),
        }

    def _everywhere(self, heldout: Heldout, a_h: Tensor, seed: int) -> Look:
        """Look at all held-out decisions under commands [K, A]."""
        self.reset(torch.ones(len(a_h), dtype=torch.bool), [seed + i for i in range(len(a_h))])
        streams = self.noise.streams()
        everyone = torch.arange(len(a_h), device=a_h.device)
        start = self._situation(heldout.latent, a_h, everyone)
        # Single decisions have no history of errors, and the expert's own commands have none.
        looks = [
            self._look(start.select(chunk), streams, looks_on=False)
            for chunk in everyone.split(CHUNK)
        ]
        target, futures, lasting, draws = zip(*looks, strict=True)
        return Look(
            torch.cat(target), Scored.joined(futures, along=0), torch.cat(lasting), draws[0]
        )
