"""Imagined rollouts: what commands lead to when an operator of whom something is assumed goes on.

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
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.packed import PackedModel
from wasp_cli.models.weights import load_module
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import DrawnNoise, Operator, Policy

# turns the step k and the operator's commands there [R, A] into actions [R, A]
Compose = Callable[[int, Tensor], Tensor]


class Situation(NamedTuple):
    """Where an imagination starts: the filtered latents, the commands just issued, and who goes
    on.
    """

    latent: Latent  # [B, .]
    a_h: Tensor  # [B, A]
    operator: Operator  # imagined from here on; it has just issued the commands
    rows: Tensor  # [B] the operator's rows that these decisions belong to

    def select(self, rows: Tensor) -> Situation:
        """Select some of the decisions (indices [R])."""
        return Situation(self.latent.rows(rows), self.a_h[rows], self.operator, self.rows[rows])


class Draws(NamedTuple):
    """Randomness of M rollouts, made before the loop and shared by every candidate (common
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
        """Draw for every decision from its own episode's stream of that purpose."""
        shapes = (horizon, rollouts, noise_size), (horizon, rollouts, start.operator.draws)
        latents, commands = streams.uniform(*shapes, purpose=purpose, rows=start.rows)
        return cls(as_gumbel(latents), commands)

    def rows(self, index: Tensor) -> Draws:
        """Select the draws of some of the decisions (indices [R])."""
        return Draws(self.latent[index], self.operator[index])

    def first(self, rollouts: int) -> Draws:
        """Select the draws of the first rollouts."""
        return Draws(self.latent[:, :, :rollouts], self.operator[:, :, :rollouts])


class Scored(NamedTuple):
    """Residual sequences of B decisions, and the mean returns of their rollouts."""

    residuals: Tensor  # [B, N, L, A]
    reward: Tensor  # G^(r) [B, N]
    cost: Tensor  # G^(c) [B, N]

    def rows(self, index: Tensor) -> Scored:
        """Select some of the decisions (indices [R])."""
        return Scored(*(field[index] for field in self))

    def take(self, index: Tensor) -> Scored:
        """Select candidates of every decision (indices [B, K])."""
        plans = index.view(*index.shape, 1, 1).expand(-1, -1, *self.residuals.shape[2:])
        return Scored(
            self.residuals.gather(1, plans),
            self.reward.gather(1, index),
            self.cost.gather(1, index),
        )

    @classmethod
    def joined(cls, batches: Sequence[Scored], along: int = 1) -> Scored:
        """Join candidates of the same decisions, or (`along` 0) decisions."""
        return cls(*(torch.cat(field, along) for field in zip(*batches, strict=True)))


@dataclass(frozen=True)
class Imagined:
    """The arrived states k = 1..H of N candidates in M rollouts of B decisions; every signal is
    [H, B, N, M].
    """

    imagination: Imagination
    arrived: Latent
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
    """Whether a `SafetyWorldModel` takes its steps packed (`models.packed`); without it by its
    own `imagine`: the reference.
    """

    @cached_property
    def packed(self) -> PackedModel | None:
        """The packed steps of the model; None where it takes its own."""
        return (
            PackedModel(self.model)
            if self.pack and isinstance(self.model, SafetyWorldModel)
            else None
        )

    @property
    def reward_unit(self) -> float:
        """The unit of rewards that the model knows; 1 where it knows none."""
        return float(getattr(self.model, "reward_unit", 1.0))

    def roll(self, start: Situation, candidates: int, compose: Compose, draws: Draws) -> Imagined:
        """Imagine N candidates of B decisions in M rollouts each.

        Args:
            start: B decisions.
            candidates: N.
            compose: says what is executed at step k when the operator commands [R, A]; at k = 0
                these are the commands just issued. Rows are ordered by decision, candidate,
                rollout. What it returns is cut at the bounds.
            draws: of the M rollouts, met by every candidate.
        """
        batch, horizon, rollouts = draws.latent.shape[:3]
        copies = candidates * rollouts
        operator = start.operator.fork(
            start.rows, copies, DrawnNoise(_met(draws.operator, candidates))
        )
        packed = self.packed
        # [H, R, Z]
        noise = _met(draws.latent if packed is None else packed.chances(draws.latent), candidates)
        room = None if packed is None else packed.room(horizon, batch * copies)
        steps: list[Latent] = []
        command = start.a_h.repeat_interleave(copies, 0)
        latent, alike = start.latent, copies  # copies of a row are alike until their actions differ
        for k in range(horizon):
            if k:
                command = operator.command(latent.features)
            action = compose(k, command).clamp(-1, 1)
            operator.observe(action)
            if packed is not None and room is not None:
                latent = packed.imagine(latent, action, noise[k], room.step(k), alike)
            else:
                latent = self.model.imagine(
                    latent.expand_rows(alike) if alike > 1 else latent, action, noise[k]
                )
                steps.append(latent)
            alike = 1
        arrived = (
            Latent(*(torch.stack(part) for part in zip(*steps, strict=True)))
            if room is None
            else room
        )
        return Imagined(self, arrived, (batch, candidates, rollouts))


def imagination_of(parts: Parts) -> Imagination:
    """Return the imagination over the trained world model, critics and expert."""
    critics = load_module(LatentCritics, parts.inputs["critics"] / "critics.safetensors").to(
        parts.device
    )
    return Imagination(
        parts.world_model, critics, parts.skills.expert, parts.gamma_r, parts.gamma_c, parts.lam
    )


def corrected(residuals: Tensor, draws: Draws) -> Compose:
    """Return what adds residuals [B, N, L, A] to the next L commands: a_{t+k}^H + delta_{t+k}."""
    delta = over_rollouts(residuals, draws.latent.shape[2])
    return lambda k, command: command + delta[:, k] if k < delta.shape[1] else command


def over_rollouts(plans: Tensor, rollouts: int) -> Tensor:
    """Repeat candidates [B, N, L, A] for every rollout, as [R, L, A]."""
    return plans.unsqueeze(2).expand(-1, -1, rollouts, -1, -1).reshape(-1, *plans.shape[2:])


def _met(draws: Tensor, candidates: int) -> Tensor:
    """Let each candidate meet draws [B, H, M, K]: as [H, R, K]."""
    batch, horizon, rollouts, size = draws.shape
    met = draws.transpose(0, 1).unsqueeze(2).expand(-1, -1, candidates, -1, -1)
    return met.reshape(horizon, batch * candidates * rollouts, size)
