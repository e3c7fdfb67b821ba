"""Imagined rollouts of the composed behaviour (Eq. 13), summarised by TD-lambda returns.

Dimension letters: B decisions, N candidates, M rollouts, H horizon, L residual steps, A action, Z latent noise, K operator draws,
R = B * N * M rows of one call to the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.returns import discounted_sum, td_lambda
from wasp_cli.models.base import Critics, Latent
from wasp_cli.models.packed import PackedModel
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import DrawnNoise, Operator, Policy

ROUNDING = 1e-6
"""A takeover's residual below this is none: the expert's own command, computed in another batch."""


class Dynamics(Protocol):
    """What an imagination asks of a world model (`models.base.WorldModel`): no perception, but whether the episode goes on."""

    action_size: int
    noise_size: int

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent: ...

    def reward(self, latent: Latent) -> Tensor: ...

    def cost(self, latent: Latent) -> Tensor: ...

    def continues(self, latent: Latent) -> Tensor:
        """Return the probability [...] that the episode has not ended at the arrived state."""
        ...


class Draws(NamedTuple):
    """Randomness of M rollouts, made before the loop and shared by every candidate (common random numbers)."""

    latent: Tensor
    """Gumbel [B, H, M, Z]"""
    operator: Tensor
    """uniform [B, H, M, K]"""

    def rows(self, index: Tensor) -> Draws:
        """Select the draws of some of the decisions (indices or mask [R])."""
        return Draws(self.latent[index], self.operator[index])

    def first(self, rollouts: int) -> Draws:
        """Select the draws of the first rollouts."""
        return Draws(self.latent[:, :, :rollouts], self.operator[:, :, :rollouts])

    def steps(self, horizon: int) -> Draws:
        """Select the draws of the first imagined steps."""
        return Draws(self.latent[:, :horizon], self.operator[:, :horizon])


class Situation(NamedTuple):
    """Where an imagination starts: the filtered latents, the commands just issued, and who issued them."""

    latent: Latent
    """[B, .]"""
    a_h: Tensor
    """[B, A]"""
    operator: Operator
    rows: Tensor
    """[B] the operator's rows that these decisions belong to"""

    def select(self, index: Tensor) -> Situation:
        """Select some of the decisions (indices or mask [R])."""
        return Situation(self.latent.rows(index), self.a_h[index], self.operator, self.rows[index])


class Returns(NamedTuple):
    """Mean imagined returns over M rollouts, and the effort of the residuals as executed."""

    reward: Tensor
    """G^(r) [B, N] (Eq. 10, 15)"""
    cost: Tensor
    """G^(c) [B, N] (Eq. 9, 14)"""
    effort: Tensor
    """sum_k ||delta_k||^2, after clipping unless `effort` says otherwise [B, N] (Eq. 11, 16, 17)"""


class Rolled(NamedTuple):
    """What became of N candidates in M rollouts of B decisions."""

    returns: Returns
    residuals: Tensor
    """[B, N, L, A] as they came about, a mean over the rollouts"""
    issued: Tensor | None
    """[B, N, M, K, A] the operator's first K commands; None where nobody asked for them"""


@dataclass(frozen=True)
class Imagination:
    """The frozen models and constants of every imagined return."""

    model: Dynamics
    critics: Critics
    config: WASPConfig
    gamma_r: float
    gamma_c: float
    lam: float
    expert: Policy | None = None
    """The nominal expert on features [R, F], whose takeovers are candidates; None where there is none."""
    pack: bool = True
    """Whether a `SafetyWorldModel` takes its steps packed (`models.packed`); without it by its own `imagine`: the reference."""

    @cached_property
    def packed(self) -> PackedModel | None:
        """The packed steps of the model; None where it takes its own."""
        return PackedModel(self.model) if self.pack and isinstance(self.model, SafetyWorldModel) else None

    def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
        """Roll every candidate out and summarise it (Eq. 7-8, 13).

        Args:
            start: B decisions.
            residuals: [B, N, L, A].
            draws: of M rollouts, shared by the N candidates.
            share: [B, N, L, 2] how much of a command the expert takes over, and how much of it is braked away, in the loop of every
                rollout; the residuals of such steps are not read. None: there is no such candidate.
            alone: so many of the first candidates are the operator alone, whatever their residuals. For the others zero residuals are a
                held command where `composition` is `hold`.
        """
        return self.rolled(start, residuals, draws, share, alone=alone).returns

    def rolled(
        self,
        start: Situation,
        residuals: Tensor,
        draws: Draws,
        share: Tensor | None = None,
        *,
        alone: int = 0,
        index: Tensor | None = None,
        heard: int = 0,
    ) -> Rolled:
        """Return what `returns` does, with what became of residuals and commands on the way.

        Args:
            start, residuals, draws, share, alone: as in `returns`.
            index: which of the draws' rollouts each candidate meets, [N, M]; None: every candidate meets all of them.
            heard: so many commands of the operator are kept.
        """
        batch, candidates, steps, actions = residuals.shape
        horizon = draws.latent.shape[1]
        if index is None:
            index = torch.arange(draws.latent.shape[2], device=residuals.device).expand(candidates, -1)
        rollouts = index.shape[1]
        shape = (batch, candidates, rollouts)
        copies = candidates * rollouts
        delta = _over_rollouts(residuals, rollouts)  # [R, L, A]
        part = None if share is None else _over_rollouts(share, rollouts)  # [R, L, 2]
        rows = draws.latent.shape[2] * torch.arange(batch, device=index.device)
        met = (rows.unsqueeze(1) + index.flatten()).flatten()  # [R] of the B * M draws
        operator = start.operator.fork(start.rows, copies, DrawnNoise(_by_step(draws.operator)[:, met]))
        packed = self.packed
        room = None if packed is None else packed.room(horizon, len(delta))
        noise = _by_step(draws.latent if packed is None else packed.chances(draws.latent))  # [H, B * M, Z]
        now = start.a_h.repeat_interleave(copies, 0)  # [R, A]
        effort = delta.new_zeros(len(delta))
        found: list[Tensor] = []
        issued: list[Tensor] = []
        seen: list[Latent] = []
        latent, alike = start.latent, copies  # copies of a row are alike until their actions differ
        for k in range(horizon):
            features = latent.features if k or part is not None else delta
            command = now if k == 0 else operator.command(features)
            if k < heard:
                issued.append(command.clamp(-1, 1))
            action = command
            if k < steps:
                base = self._base(now, command, shape, alone)
                wanted = base + delta[:, k]
                if part is not None:
                    wanted = self._taken_over(features, alike, base, wanted, part[:, k])
                action = wanted.clamp(-1, 1)
                effort = effort + ((action if self.config.effort == "clipped" else wanted) - base).square().sum(-1)
                found.append(action - base)
            operator.observe(action)
            drawn = noise[k].index_select(0, met)  # [R, Z]
            if packed is not None and room is not None:
                latent = packed.imagine(latent, action, drawn, room.step(k), alike)
            else:
                latent = self.model.imagine(latent.expand_rows(alike) if alike > 1 else latent, action, drawn)
                seen.append(latent)
            alike = 1
        # Every head runs once, on all steps.
        arrived = Latent(*(torch.stack(part) for part in zip(*seen, strict=True))) if room is None else room
        keep = self.model.continues(arrived) if self.config.continuation else None
        gamma_r, gamma_c = self.discounts
        reward = self._summary(self.model.reward(arrived), self.critics.value_r, self.config.bootstrap_reward, gamma_r, arrived, keep)
        cost = self._summary(self.model.cost(arrived), self.critics.value_c, self.config.bootstrap_cost, gamma_c, arrived, keep)
        returns = Returns(*(field.view(shape).mean(-1) for field in (reward, cost, effort)))
        commands = torch.stack(issued, 1).view(*shape, heard, actions) if heard else None
        if part is None:
            return Rolled(returns, residuals, commands)
        realised = torch.stack(found, 1).view(*shape, steps, actions).mean(2)
        realised = torch.where(realised.abs() < ROUNDING, 0.0, realised)
        return Rolled(returns, torch.where(closed_loop(share), realised, residuals), commands)

    def nominal(self, start: Situation, draws: Draws) -> Returns:
        """Roll out the operator alone (Eq. 9-10). Fields are [B]."""
        batch, actions = start.a_h.shape
        nothing = start.a_h.new_zeros(batch, 1, self.config.residual_steps, actions)
        return Returns(*(field.squeeze(1) for field in self.returns(start, nothing, draws, alone=1)))

    @property
    def discounts(self) -> tuple[float, float]:
        """Return gamma of rewards and of costs."""
        two = {"two": (self.gamma_r, self.gamma_c), "reward": (self.gamma_r, self.gamma_r), "cost": (self.gamma_c, self.gamma_c)}
        return two[self.config.discounts]

    def _base(self, now: Tensor, command: Tensor, shape: tuple[int, ...], alone: int) -> Tensor:
        """Return the commands [R, A] that residuals are added to: those of the moment, or the held one of Eq. 13 as printed."""
        if self.config.composition == "per_step":
            return command
        if not alone:
            return now
        # Eq. 9-10 know no correction: without one nothing holds the first command.
        first = torch.arange(shape[1], device=now.device).view(1, -1, 1).expand(shape).reshape(-1, 1) < alone
        return torch.where(first, command, now)

    def _taken_over(self, features: Tensor, alike: int, base: Tensor, open_loop: Tensor, part: Tensor) -> Tensor:
        """Return the actions [R, A] of candidates of which some are taken over in this step: part [R, 2], features [R / alike, F]."""
        if self.expert is None:
            raise ValueError("takeovers need the nominal expert")
        expert = self.expert(features)
        if alike > 1:
            expert = expert.repeat_interleave(alike, 0)
        taken = base + part[:, :1] * (expert - base) - part[:, 1:] * base
        return torch.where((part > 0).any(-1, keepdim=True), taken, open_loop)

    def _summary(
        self, signal: Tensor, value: Callable[[Latent], Tensor], bootstrap: bool, gamma: float, arrived: Latent, keep: Tensor | None
    ) -> Tensor:
        """Summarise a signal [H, R] at the arrived latents as a return [R]: Eq. 8 in full, or the discounted sum over H alone."""
        if bootstrap:
            return td_lambda(signal, value(arrived), gamma, self.lam, keep)
        return discounted_sum(signal, gamma, keep)


def closed_loop(share: Tensor | None) -> Tensor:
    """Return which steps of candidates [B, N, L, 2] are taken over: bool [B, N, L, 1]."""
    assert share is not None
    return (share > 0).any(-1, keepdim=True)


def _over_rollouts(plans: Tensor, rollouts: int) -> Tensor:
    """Repeat [B, N, L, K] as [B * N * M, L, K]."""
    return plans.unsqueeze(2).expand(-1, -1, rollouts, -1, -1).reshape(-1, *plans.shape[2:])


def _by_step(draws: Tensor) -> Tensor:
    """Order draws [B, H, M, K] as [H, B * M, K]."""
    return draws.transpose(0, 1).flatten(1, 2)
