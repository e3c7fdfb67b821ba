"""Worlds with a known answer, and who drives through them: a point with inertia, a hazard, and a
driver who is late.

The worlds are written down, not learned. They offer what WASP asks of a world model, so every
number can be checked by hand, and a plan against an exhaustive search. Dimension letters: B rows, A
action size (1 in the corridor, 2 in the plane).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, Policy
from wasp_cli.operators.delayed import DelayedOperator

STEP = 0.1
"""Seconds of a decision step."""
THRUST, DRAG = 1.0, 1.0
"""v' = v + STEP (THRUST a - DRAG v), p' = p + STEP v': full thrust holds 1 m/s, and stopping
from there takes seven steps and 0.24 m.
"""
PAY = 10.0
"""Reward of a metre towards the goal."""
ARRIVED = 0.15
"""Metres from the goal at which an episode ends."""
BLUR = 0.02
"""Metres over which the predicted probability of a cost goes from 0 to 1 at the hazard's edge,
as that of a trained head would.
"""

REACTION = 0.4
"""Seconds by which the slow driver is late."""
SIGHT = 0.45
"""Metres before the hazard at which the careful driver brakes."""
GAIN = 2.0
"""Command per m/s of wrong speed: more would make a driver who is late sway."""


class PointWorld(ABC):
    """A point with inertia: h = [p, v] in m and m/s [..., 2A], z = [reward of the step that led
    here] [..., 1].

    The noise input, made standard, shifts the velocity by `jitter` m/s per step, so that rollouts
    differ.
    """

    action_size: int

    def __init__(
        self, start: tuple[float, ...], goal: tuple[float, ...], jitter: float, dtype: torch.dtype
    ) -> None:
        self.start, self.goal, self.jitter, self.dtype = (
            start,
            torch.tensor(goal, dtype=dtype),
            jitter,
            dtype,
        )
        self.noise_size = self.action_size

    def at(self, *states: tuple[float, ...]) -> Latent:
        """Latents of states (p_1, .., p_A, v_1, .., v_A), one row each."""
        h = torch.tensor(states, dtype=self.dtype)
        return Latent(h, torch.zeros(len(states), 1, dtype=self.dtype))

    def initial(self, batch: int) -> Latent:
        return self.at(*[self.start] * batch)

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        place, speed = latent.h.split(self.action_size, -1)
        # a Gumbel draw has mean 0.5772 and deviation pi / sqrt(6)
        gust = (noise - 0.5772) * (math.sqrt(6.0) / math.pi)
        onward = speed + STEP * (THRUST * action - DRAG * speed) + self.jitter * gust
        there = place + STEP * onward
        return Latent(
            torch.cat([there, onward], -1),
            PAY * (self.left(place) - self.left(there)).unsqueeze(-1),
        )

    def reward(self, latent: Latent) -> Tensor:
        return latent.z[..., 0]

    def cost(self, latent: Latent) -> Tensor:
        return torch.sigmoid(self.depth(latent.h[..., : self.action_size]) / BLUR)

    def continues(self, latent: Latent) -> Tensor:
        return (self.left(latent.h[..., : self.action_size]) > ARRIVED).to(self.dtype)

    def inside(self, latent: Latent) -> Tensor:
        """The true cost in {0, 1}: whether the place is in the hazard [...]."""
        return (self.depth(latent.h[..., : self.action_size]) > 0).to(self.dtype)

    def left(self, place: Tensor) -> Tensor:
        """Metres from places [..., A] to the goal: [...]."""
        return (self.goal - place).norm(dim=-1)

    @abstractmethod
    def depth(self, place: Tensor) -> Tensor:
        """Metres from places [..., A] to the hazard's edge, positive within and negative
        without: [...].
        """

    @abstractmethod
    def ahead(self, place: Tensor) -> Tensor:
        """Metres to the hazard on the straight way from places [..., A] to the goal: [...],
        infinite where that way is free.

        From within, the hazard is no longer ahead.
        """


class Corridor(PointWorld):
    """A hazard from `low` to `high` fills the way: all there is to do is to stop before it, and
    only driving through it pays.
    """

    action_size = 1

    def __init__(
        self,
        low: float = 2.0,
        high: float = 2.6,
        jitter: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__((0.0, 0.0), (3.4,), jitter, dtype)
        self.low, self.high = low, high

    def depth(self, place: Tensor) -> Tensor:
        return torch.minimum(place[..., 0] - self.low, self.high - place[..., 0])

    def ahead(self, place: Tensor) -> Tensor:
        gap = self.low - place[..., 0]
        return torch.where(gap >= 0, gap, torch.inf)


class Fork(PointWorld):
    """A round hazard lies across the straight way to the goal, a little to its right: braking
    is safe, and steering around it also pays.
    """

    action_size = 2

    def __init__(
        self,
        centre: tuple[float, float] = (1.9, -0.15),
        radius: float = 0.5,
        jitter: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__((0.0, 0.0, 0.0, 0.0), (3.6, 0.0), jitter, dtype)
        self.centre, self.radius = torch.tensor(centre, dtype=dtype), radius

    def depth(self, place: Tensor) -> Tensor:
        return self.radius - (place - self.centre).norm(dim=-1)

    def ahead(self, place: Tensor) -> Tensor:
        along, aside = self.bearing(place)
        # half the chord that the straight way cuts
        gap = along - (self.radius**2 - aside.square()).clamp(min=0).sqrt()
        return torch.where((aside.abs() < self.radius) & (gap >= 0), gap, torch.inf)

    def bearing(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Where the hazard's centre lies as seen from places [..., 2] towards the goal: metres
        ahead and metres to the left, [...] each.
        """
        way = direction(self.goal - place)
        to = self.centre - place
        return (way * to).sum(-1), way[..., 0] * to[..., 1] - way[..., 1] * to[..., 0]


# -- drivers ---------------------------------------------------------------------------------------


def careful(world: PointWorld) -> Policy:
    """A driver who heads straight for the goal at 1 m/s and brakes in front of a hazard; it does
    not occur to him to steer around it.

    Prompt, he stops in time.
    """

    def command(features: Tensor) -> Tensor:
        place, speed = features[..., : 2 * world.action_size].split(world.action_size, -1)
        way = direction(world.goal - place)
        return steered(torch.where((world.ahead(place) < SIGHT).unsqueeze(-1), 0.0, way), speed)

    return command


def around(world: Fork, room: float = 0.12) -> Policy:
    """The expert of the plane: he passes the hazard on the left, `room` metres from it."""

    def command(features: Tensor) -> Tensor:
        place, speed = features[..., :4].split(2, -1)
        along, aside = world.bearing(place)
        # To the left of the centre by the angle at which the tangent leaves `room`; nothing to do
        # if the way to the goal leaves more.
        half = torch.asin(((world.radius + room) / torch.hypot(along, aside)).clamp(max=1.0))
        turn = torch.atan2(aside, along) + half
        turn = torch.where((along > 0) & (turn > 0), turn, 0.0)
        way = direction(world.goal - place)
        turned = torch.stack(
            [
                way[..., 0] * turn.cos() - way[..., 1] * turn.sin(),
                way[..., 0] * turn.sin() + way[..., 1] * turn.cos(),
            ],
            -1,
        )
        return steered(turned, speed)

    return command


def direction(way: Tensor) -> Tensor:
    """Unit vectors of [..., A]."""
    return way / way.norm(dim=-1, keepdim=True).clamp(min=1e-9)


def steered(wanted: Tensor, speed: Tensor) -> Tensor:
    """The command [..., A] that holds a wanted velocity [..., A] and mends what is missing."""
    return (DRAG / THRUST * wanted + GAIN * (wanted - speed)).clamp(-1, 1)


def driver(
    world: PointWorld, policy: Policy, seconds: float = REACTION, batch: int = 1
) -> Operator:
    """B drivers of one policy who react late by some seconds."""
    return DelayedOperator.build(
        seconds,
        OperatorContext(lambda _: policy, world.action_size, STEP),
        EpisodeNoise(range(batch)),
        batch,
    )
