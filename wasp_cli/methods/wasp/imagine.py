"""Imagined rollouts of the composed behaviour (Eq. 13), summarised by TD-lambda returns.

Dimension letters: B decisions, N candidates, M rollouts, H horizon, L residual steps, A action, Z latent noise, K operator draws,
R = B * N * M rows of one call to the model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.returns import discounted_sum, td_lambda
from wasp_cli.models.base import Critics, Latent
from wasp_cli.operators.base import DrawnNoise, Operator


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


class Arrived(Latent):
    """Latents that the operator and several heads read: h and z are joined once for all of them."""

    @cached_property
    def features(self) -> Tensor:
        """Join h and z: [..., D + Z]."""
        return super().features

    @classmethod
    def stack(cls, steps: Sequence[Arrived]) -> Arrived:
        """Stack K steps [R, .] as one [K, R, .]."""
        features = torch.stack([step.features for step in steps])
        size = steps[0].h.shape[-1]
        made = cls(features[..., :size], features[..., size:])
        made.__dict__["features"] = features  # h and z are views of it
        return made


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
    """sum_k ||delta_k||^2 after clipping [B, N] (Eq. 11, 16, 17)"""


@dataclass(frozen=True)
class Imagination:
    """The frozen models and constants of every imagined return."""

    model: Dynamics
    critics: Critics
    config: WASPConfig
    gamma_r: float
    gamma_c: float
    lam: float

    def returns(self, start: Situation, residuals: Tensor, draws: Draws) -> Returns:
        """Roll every candidate out and summarise it (Eq. 7-8, 13).

        Args:
            start: B decisions.
            residuals: [B, N, L, A].
            draws: of M rollouts, shared by the N candidates.
        """
        batch, candidates, steps, actions = residuals.shape
        rollouts, horizon = draws.latent.shape[2], draws.latent.shape[1]
        copies = candidates * rollouts
        delta = residuals.unsqueeze(2).expand(-1, -1, rollouts, -1, -1).reshape(-1, steps, actions)  # [R, L, A]
        operator = start.operator.fork(start.rows, copies, DrawnNoise(_over_candidates(draws.operator, candidates)))
        noise = _over_candidates(draws.latent, candidates)  # [H, R, Z]
        latent = start.latent.expand_rows(copies)
        now = start.a_h.repeat_interleave(copies, 0)  # [R, A]
        effort = delta.new_zeros(len(delta))
        seen: list[Arrived] = []
        for k in range(horizon):
            command = now if k == 0 else operator.command(latent.features)
            action = command
            if k < steps:
                base = now if self.config.composition == "hold" else command
                # Clip before the model and before the penalty: what is penalised is what would be executed.
                action = (base + delta[:, k]).clamp(-1, 1)
                effort = effort + (action - base).square().sum(-1)
            latent = Arrived(*self.model.imagine(latent, action, noise[k]))
            seen.append(latent)
        arrived = Arrived.stack(seen)  # every head runs once, on all steps
        keep = self.model.continues(arrived) if self.config.continuation else None
        reward = self._summary(self.model.reward(arrived), self.critics.value_r, self.config.bootstrap_reward, self.gamma_r, arrived, keep)
        cost = self._summary(self.model.cost(arrived), self.critics.value_c, self.config.bootstrap_cost, self.gamma_c, arrived, keep)
        shape = (batch, candidates, rollouts)
        return Returns(reward.view(shape).mean(-1), cost.view(shape).mean(-1), effort.view(shape).mean(-1))

    def nominal(self, start: Situation, draws: Draws) -> Returns:
        """Roll out the operator alone: one candidate without residuals (Eq. 9-10). Fields are [B]."""
        batch, actions = start.a_h.shape
        nothing = start.a_h.new_zeros(batch, 1, self.config.residual_steps, actions)
        found = self.returns(start, nothing, draws)
        return Returns(found.reward.squeeze(1), found.cost.squeeze(1), found.effort.squeeze(1))

    def _summary(
        self, signal: Tensor, value: Callable[[Latent], Tensor], bootstrap: bool, gamma: float, arrived: Latent, keep: Tensor | None
    ) -> Tensor:
        """Summarise a signal [H, R] at the arrived latents as a return [R]: Eq. 8 in full, or the discounted sum over H alone."""
        if bootstrap:
            return td_lambda(signal, value(arrived), gamma, self.lam, keep)
        return discounted_sum(signal, gamma, keep)


def _over_candidates(draws: Tensor, candidates: int) -> Tensor:
    """Repeat [B, H, M, K] as [H, B * N * M, K]: the same draws for each of the N candidates."""
    batch, horizon, rollouts, size = draws.shape
    spread = draws.unsqueeze(1).expand(-1, candidates, -1, -1, -1)  # [B, N, H, M, K]
    return spread.permute(2, 0, 1, 3, 4).reshape(horizon, batch * candidates * rollouts, size)
