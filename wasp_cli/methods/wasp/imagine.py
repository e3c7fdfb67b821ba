"""Imagined rollouts: what commands lead to if an operator, as it is imagined, goes on.

B decisions, N candidates, M rollouts, H horizon, L residual steps, A actions, Z latent noise, K
operator draws, R = B * N * M rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.methods.base import Parts
from wasp_cli.methods.noise import Streams, as_gumbel
from wasp_cli.models.base import Critics, Dynamics, Latent
from wasp_cli.models.coded import Coded
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.packed import PackedModel
from wasp_cli.models.weights import load_module
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import DrawnNoise, Operator, Policy

# turns the step k and the operator's commands there [R, A] into actions [R, A]
Compose = Callable[[int, Tensor], Tensor]


class Situation(NamedTuple):
    """Where an imagination of B decisions starts."""

    latent: Latent  # [B, .] filtered
    a_h: Tensor  # [B, A] the commands just issued
    operator: Operator  # who issued them, and commands in imagination from here on
    rows: Tensor  # [B] the operator's rows that these decisions belong to

    def select(self, rows: Tensor) -> Situation:
        """Return some of the decisions (indices [R])."""
        return Situation(self.latent.rows(rows), self.a_h[rows], self.operator, self.rows[rows])


class Draws(NamedTuple):
    """Randomness of M rollouts. It is drawn before the loop and shared by every candidate (common
    random numbers).
    """

    latent: Tensor  # Gumbel [B, H, M, Z]
    operator: Tensor  # uniform [B, H, M, K]

    @classmethod
    def of(
        cls,
        streams: Streams,
        purpose: int,
        start: Situation,
        horizon: int,
        rollouts: int,
        noise_size: int,
    ) -> Draws:
        """Draw for every decision from its own episode's stream of that purpose.

        Args:
            streams: of the decision.
            purpose: number of the stream.
            start: B decisions.
            horizon: H.
            rollouts: M.
            noise_size: Z, Gumbel variables of a step of the model.
        """
        of_latent = (horizon, rollouts, noise_size)
        of_operator = (horizon, rollouts, start.operator.draws)
        latents, commands = streams.uniform(
            of_latent, of_operator, purpose=purpose, rows=start.rows
        )
        return cls(as_gumbel(latents), commands)

    def rows(self, index: Tensor) -> Draws:
        """Return the draws of some of the decisions (indices [R])."""
        return Draws(self.latent[index], self.operator[index])

    def first(self, rollouts: int) -> Draws:
        """Return the draws of the first `rollouts` rollouts."""
        return Draws(self.latent[:, :, :rollouts], self.operator[:, :, :rollouts])


class Scored(NamedTuple):
    """Residual sequences of B decisions, and the mean returns of their rollouts."""

    residuals: Tensor  # [B, N, L, A]
    reward: Tensor  # G^(r) [B, N], in the task's rewards (Eq. 10, 15)
    cost: Tensor  # G^(c) [B, N], in costly decisions (Eq. 9)

    def rows(self, index: Tensor) -> Scored:
        """Return some of the decisions (indices [R])."""
        return Scored(self.residuals[index], self.reward[index], self.cost[index])

    def take(self, index: Tensor) -> Scored:
        """Return some candidates of every decision (indices [B, K])."""
        plans = index.view(*index.shape, 1, 1).expand(-1, -1, *self.residuals.shape[2:])
        return Scored(
            self.residuals.gather(1, plans),
            self.reward.gather(1, index),
            self.cost.gather(1, index),
        )

    @classmethod
    def joined(cls, batches: Sequence[Scored], along: int = 1) -> Scored:
        """Join candidates of the same decisions (`along` 1), or decisions (`along` 0)."""
        return cls(
            torch.cat([batch.residuals for batch in batches], along),
            torch.cat([batch.reward for batch in batches], along),
            torch.cat([batch.cost for batch in batches], along),
        )


@dataclass(frozen=True)
class Imagined:
    """The arrived states k = 1..H of N candidates in M rollouts of B decisions. Every signal is
    [H, B, N, M].
    """

    imagination: Imagination
    arrived: Latent  # [H, R, .]
    shape: tuple[int, int, int]  # B, N, M

    def reward(self) -> Tensor:
        """Return r-hat of every step."""
        return self._shaped(self.imagination.model.reward(self.arrived))

    def cost(self) -> Tensor:
        """Return c-hat of every step: the probability of a cost."""
        return self._shaped(self.imagination.model.cost(self.arrived))

    def continues(self) -> Tensor:
        """Return the probability that the episode goes on after every step."""
        return self._shaped(self.imagination.model.continues(self.arrived))

    def value_r(self) -> Tensor:
        """Return V_r of every arrived state."""
        return self._shaped(self.imagination.critics.value_r(self.arrived))

    def value_c(self) -> Tensor:
        """Return V_c of every arrived state."""
        return self._shaped(self.imagination.critics.value_c(self.arrived))

    def _shaped(self, signal: Tensor) -> Tensor:
        return signal.view(-1, *self.shape)


@dataclass(frozen=True)
class Imagination:
    """The frozen models of every imagined return."""

    model: Dynamics
    critics: Critics
    expert: Policy  # the nominal expert, features [R, F] to commands [R, A]
    gamma_r: float  # discount of rewards, at which V_r was trained
    gamma_c: float  # discount of costs, at which V_c was trained
    lam: float  # lambda of Eq. 8
    pack: bool = True
    """Whether a `SafetyWorldModel` takes its steps packed (`models.packed`). Without it the model
    takes them by its own `imagine`, which is the reference.
    """

    @cached_property
    def packed(self) -> PackedModel | None:
        """The packed steps of the model; None where it takes its own."""
        if self.pack and isinstance(self.model, SafetyWorldModel):
            return PackedModel(self.model)
        return None

    @property
    def reward_unit(self) -> float:
        """The unit of rewards that the model knows; 1 where it knows none."""
        return float(getattr(self.model, "reward_unit", 1.0))

    def roll(self, start: Situation, candidates: int, compose: Compose, draws: Draws) -> Imagined:
        """Imagine N candidates of B decisions in M rollouts each.

        Args:
            start: B decisions.
            candidates: N.
            compose: returns what is executed at step k if the operator commands [R, A]; at k = 0
                these are the commands just issued. Rows are ordered by decision, candidate,
                rollout. What it returns is cut at the bounds.
            draws: of the M rollouts; every candidate meets them.

        Returns:
            The states that the steps arrive in. The operator of `start` remembers nothing of it:
            a fork of it commands.
        """
        batch, horizon, rollouts = draws.latent.shape[:3]
        copies = candidates * rollouts  # rows of a decision

        # Every rollout has an operator of its own, which remembers what the real one does.
        uniforms = _for_candidates(draws.operator, candidates)  # [H, R, K]
        operator = start.operator.fork(start.rows, copies, DrawnNoise(uniforms))

        # The packed model needs its own form of the draws, and memory for the arrived states.
        packed = self.packed
        arrived: Coded | None = None
        if packed is None:
            noise = _for_candidates(draws.latent, candidates)  # [H, R, Z]
        else:
            noise = _for_candidates(packed.chances(draws.latent), candidates)
            arrived = packed.room(horizon, batch * copies)

        # Roll out. The rows of a decision share their latent until they have acted differently, so
        # that the first step is given B latents [B, .] for R actions.
        steps: list[Latent] = []
        latent = start.latent
        command = start.a_h.repeat_interleave(copies, 0)  # [R, A]
        rows_per_latent = copies
        for k in range(horizon):
            if k > 0:
                command = operator.command(latent.features)
            action = compose(k, command).clamp(-1, 1)
            operator.observe(action)
            if packed is not None and arrived is not None:
                latent = packed.imagine(latent, action, noise[k], arrived.step(k), rows_per_latent)
            else:
                if rows_per_latent > 1:
                    latent = latent.expand_rows(rows_per_latent)
                latent = self.model.imagine(latent, action, noise[k])
                steps.append(latent)
            rows_per_latent = 1

        shape = (batch, candidates, rollouts)
        if arrived is not None:
            return Imagined(self, arrived, shape)
        h = torch.stack([step.h for step in steps])  # [H, R, D]
        z = torch.stack([step.z for step in steps])
        return Imagined(self, Latent(h, z), shape)


def imagination_of(parts: Parts) -> Imagination:
    """Return the imagination over the trained world model, critics and expert."""
    critics = load_module(LatentCritics, parts.inputs["critics"] / "critics.safetensors")
    return Imagination(
        parts.world_model,
        critics.to(parts.device),
        parts.skills.expert,
        parts.gamma_r,
        parts.gamma_c,
        parts.lam,
    )


def corrected(residuals: Tensor, draws: Draws) -> Compose:
    """Return what adds residuals [B, N, L, A] to the first L commands: a_{t+k}^H + delta_{t+k}
    (Eq. 13, with the operator's command of step k in the place of that of now).
    """
    delta = over_rollouts(residuals, draws.latent.shape[2])  # [R, L, A]
    steps = delta.shape[1]

    def compose(k: int, command: Tensor) -> Tensor:
        if k < steps:
            return command + delta[:, k]
        return command

    return compose


def over_rollouts(plans: Tensor, rollouts: int) -> Tensor:
    """Repeat candidates [B, N, L, A] for every rollout, as [R, L, A]."""
    return plans.unsqueeze(2).expand(-1, -1, rollouts, -1, -1).reshape(-1, *plans.shape[2:])


def _for_candidates(draws: Tensor, candidates: int) -> Tensor:
    """Repeat draws [B, H, M, K] for every candidate, as [H, R, K]."""
    batch, horizon, rollouts, size = draws.shape
    by_step = draws.transpose(0, 1).unsqueeze(2).expand(-1, -1, candidates, -1, -1)
    return by_step.reshape(horizon, batch * candidates * rollouts, size)
