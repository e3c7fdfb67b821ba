"""Analytic worlds with known answers, as test doubles of the world-model contract, and small random artifacts."""

import torch
from torch import Tensor

from wasp_cli.models.base import Latent


class Corridor:
    """A point on a line: h = [x], z = [cost at x]. Actions move it by 0.1 a; it pays reward 0.1 a and costs between `low` and `high`.

    The noise input shifts the position by `jitter` times its first variable, so that rollouts differ.
    """

    action_size = 1
    noise_size = 2

    def __init__(self, low: float, high: float, jitter: float = 0.0, dtype: torch.dtype = torch.float32) -> None:
        self.low, self.high, self.jitter, self.dtype = low, high, jitter, dtype

    def initial(self, batch: int) -> Latent:
        return Latent(torch.zeros(batch, 1, dtype=self.dtype), torch.zeros(batch, 1, dtype=self.dtype))

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
