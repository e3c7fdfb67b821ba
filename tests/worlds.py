"""Analytic worlds with known answers, as test doubles of the world-model contract, and small
random artifacts.
"""

from typing import Any

import torch
from torch import Tensor

from wasp_cli.methods.base import Heldout
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator


class Corridor:
    """A point on a line: h = [x], z = [cost at x]. Actions move it by 0.1 a; it pays reward 0.1 a
    and costs between `low` and `high`.

    The noise input shifts the position by `jitter` times its first variable, so that rollouts
    differ.
    """

    action_size = 1
    noise_size = 2

    def __init__(
        self, low: float, high: float, jitter: float = 0.0, dtype: torch.dtype = torch.float32
    ) -> None:
        self.low, self.high, self.jitter, self.dtype = low, high, jitter, dtype

    def initial(self, batch: int) -> Latent:
        return Latent(
            torch.zeros(batch, 1, dtype=self.dtype), torch.zeros(batch, 1, dtype=self.dtype)
        )

    def at(self, *positions: float) -> Latent:
        x = torch.tensor(positions, dtype=self.dtype).unsqueeze(-1)
        return Latent(x, torch.zeros_like(x))

    def filter(self, latent: Latent, action: Tensor, pixels: Tensor, first: Tensor) -> Latent:
        raise AssertionError("a corridor is imagined, never seen")

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        x = latent.h + 0.1 * action + self.jitter * noise[:, :1]
        return Latent(x, 0.1 * action)

    def reward(self, latent: Latent) -> Tensor:
        return latent.z[..., 0]

    def cost(self, latent: Latent) -> Tensor:
        x = latent.h[..., 0]
        return ((x > self.low) & (x < self.high)).to(x.dtype)

    def continues(self, latent: Latent) -> Tensor:
        return torch.ones_like(latent.h[..., 0])


class Slope:
    """A step adds `gain` * a_0 to h, and costs with probability h (within [0, 1]); noise moves
    h by `shake` times its first variable.
    """

    action_size, noise_size = 2, 3

    def __init__(self, gain: float, shake: float = 0.0) -> None:
        self.gain, self.shake = gain, shake

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        return Latent(latent.h + self.gain * action[:, :1] + self.shake * noise[:, :1], latent.z)

    def cost(self, latent: Latent) -> Tensor:
        return latent.h[..., 0].clamp(0, 1)

    def continues(self, latent: Latent) -> Tensor:
        return torch.ones_like(latent.h[..., 0])


def at(h: Tensor) -> Latent:
    return Latent(h.unsqueeze(-1), torch.zeros(len(h), 1))


def anybody(rows: int) -> Operator:
    return Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * rows), rows)


def decided(assistant: Any, h: Tensor, a_h: Tensor) -> tuple[Tensor, Any]:
    """What an assistant executes at h [B] instead of commands, and its record."""
    assistant.reset(torch.ones(len(h), dtype=torch.bool), list(range(len(h))))
    decision = assistant.decide(at(h), a_h, anybody(len(h)))
    return decision.action, decision.record


def calibrated(assistant: Any, h: Tensor, a_h: Tensor, ahead: Tensor) -> dict[str, float]:
    """What an assistant finds on held-out rows of the expert, behind which so much cost was
    ahead.
    """
    zeros = torch.zeros(len(h))
    found: dict[str, float] = assistant.calibrate(
        Heldout(at(h), a_h, zeros, zeros, zeros.long(), zeros), ahead, anybody(len(h)), 3
    )
    return found


class LinearCritics:
    """V_r = 0.5 x, V_c = 0.25 |x|."""

    def value_r(self, latent: Latent) -> Tensor:
        return 0.5 * latent.h[..., 0]

    def value_c(self, latent: Latent) -> Tensor:
        return 0.25 * latent.h[..., 0].abs()


class NoCritics:
    """Nothing beyond the horizon."""

    def value_r(self, latent: Latent) -> Tensor:
        return torch.zeros_like(latent.h[..., 0])

    value_c = value_r
