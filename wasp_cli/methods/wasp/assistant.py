"""WASP: does this command do harm that the expert could not put right one decision later?

Both gates compare two futures on common draws: the command, then the expert; the best correction
now, then the expert. Nothing of the operator's rule is imagined. The correction is the least one of
its force. B decisions side by side, M rollouts of H steps, N candidates, L residual steps, A
actions, K held-out decisions.
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
from wasp_cli.methods.wasp.returns import discounted_sum, distributions, quantile, td_lambda
from wasp_cli.methods.wasp.search import search
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import DrawnNoise, Operator
from wasp_cli.tasks.motors import Motors

GATES, SEARCH, FINALISTS = range(3)  # what a decision draws for, each from a stream of its own
TAU_C, TAU_R = 0.5, 0.1  # thresholds that are to be calibrated, where no calibration exists yet
MISTAKES = 4  # random commands for each held-out decision, from which tau_r comes
CHUNK = 64  # held-out decisions that are looked at together


def wasp(config: Config, parts: Parts) -> WASP:
    """Build WASP over the trained world model and critics."""
    settings, imagination = cast(WASPConfig, config), imagination_of(parts)
    adversity = None
    if settings.adversary == "lucid":
        adversity = adversity_of(parts, imagination, settings.adversary_budget)
    return WASP(
        settings, imagination, parts.thresholds, parts.motors, parts.device, adversity=adversity
    )


class Look(NamedTuple):
    """The two futures of B decisions: N = 2."""

    target: Tensor  # [B, A] the least action of the expert's force
    futures: Scored  # the command, then the expert; the correction, then the expert
    draws: Draws  # of these rollouts

    @property
    def gain(self) -> Tensor:
        """Return Delta G [B] (Eq. 12): what the correction gains."""
        return self.futures.reward[:, 1] - self.futures.reward[:, 0]

    @property
    def effective(self) -> Tensor:
        """Return where the correction has another force than the command: bool [B]."""
        return (self.futures.residuals[:, 1] != 0).any(-1).any(-1)


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
        self.config, self.imagination, self.motors = config, imagination, motors
        self.adversity = adversity
        # one imagined step, and both critics behind it
        self.single = config.variant == "no-rollout"
        self.horizon, self.steps = (
            (1, 1) if self.single else (config.horizon, config.residual_steps)
        )
        fixed = config.tau_c if isinstance(config.tau_c, float | int) and not self.single else None
        self.tau_c = thresholds.get("tau_c", TAU_C) if fixed is None else float(fixed)
        self.tau_r = (
            thresholds.get("tau_r", TAU_R) if config.tau_r == "calibrated" else float(config.tau_r)
        )
        self.noise, self.device = DecisionNoise(device), device
        # [B, L, A] what the search chose at the last decision; zeros where it was not asked
        self.plan = torch.zeros(0)
        self.resting = torch.zeros(0, dtype=torch.bool)  # [B] the episode has ended
        # set where somebody waits: a search that it ends returns its best so far
        self.time_is_up: Callable[[], bool] = lambda: False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)
        size = (len(rows), self.steps, self.imagination.model.action_size)
        if self.plan.shape != size:
            self.plan, self.resting = (
                torch.zeros(size, device=self.device),
                torch.zeros(len(rows), dtype=torch.bool, device=self.device),
            )
        rows = rows.to(self.device)
        # a plan never crosses the boundary of an episode
        self.plan = torch.where(rows.view(-1, 1, 1), 0.0, self.plan)
        self.resting = self.resting & ~rows

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
        config, streams = self.config, self.noise.streams()
        here = chosen(~self.resting)
        start = self._situation(latent, a_h, here)
        outcome = Outcome(a_h, self.motors, config.iterations, self.steps)

        # Imagine the command, then the expert; and the correction, then the expert (Eq. 9-10, 13).
        look = self._look(start, streams)
        cost, nothing = (
            look.futures.cost,
            torch.zeros(len(here), dtype=torch.bool, device=a_h.device),
        )
        outcome.saw(here, cost[:, 0], look.futures.reward[:, 0], look.gain)

        # Safety gate: the command costs more than tau_c (Eq. 9). Task gate: it does not, and a safe
        # correction gains tau_r (Eq. 11-12).
        fired = nothing if config.variant == "task-only" else cost[:, 0] > self.tau_c
        safe = cost[:, 1] <= self.tau_c
        worth = (
            nothing
            if config.variant == "safety-only"
            else ~fired & safe & look.effective & (look.gain > self.tau_r)
        )
        gate = torch.where(fired, GATE_SAFETY, GATE_TASK).to(torch.int8)
        outcome.carry_out(
            here, (fired & safe) | worth, gate, Plan.unsearched(look.futures, config.iterations)
        )

        # Where the expert's action is not safe either, search (Eq. 13-17).
        rows = chosen(fired & ~safe)
        plan = torch.zeros_like(self.plan)
        if len(rows):
            made = self._search(
                start.select(rows),
                Look(look.target[rows], look.futures.rows(rows), look.draws.rows(rows)),
                streams,
            )
            outcome.carry_out(here[rows], (fired & ~safe)[rows], gate[rows], made)
            plan[here[rows]] = torch.where(
                (fired & ~safe)[rows].view(-1, 1, 1), made.residuals, 0.0
            )
        self.plan = plan
        return outcome.decision()

    def _situation(self, latent: Latent, a_h: Tensor, here: Tensor) -> Situation:
        expert = Operator(
            self.imagination.expert, a_h.shape[1], DrawnNoise(a_h.new_zeros(0, 1, 0)), len(a_h)
        )
        start = Situation(latent, a_h, expert, torch.arange(len(a_h), device=a_h.device))
        return start if len(here) == len(a_h) else start.select(here)

    def _look(self, start: Situation, streams: Streams) -> Look:
        draws = self._draws(streams, GATES, start)
        target = self.motors.least(
            start.a_h, self.imagination.expert(start.latent.features).clamp(-1, 1)
        )
        residuals = start.a_h.new_zeros(len(target), 2, self.steps, target.shape[1])
        residuals[:, 1, 0] = target - start.a_h
        return Look(target, self._scored(start, residuals, draws), draws)

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
        models, keep = self.imagination, imagined.continues()
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
        looks = [self._look(start.select(chunk), streams) for chunk in everyone.split(CHUNK)]
        target, futures, draws = zip(*looks, strict=True)
        return Look(torch.cat(target), Scored.joined(futures, along=0), draws[0])
