"""Diffusion (Yoneda et al. 2023): the command is partly diffused and denoised toward the
expert's actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Parts
from wasp_cli.methods.configs import DiffusionConfig
from wasp_cli.methods.noise import CPU, DecisionNoise, Streams
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule
from wasp_cli.models.weights import load_weights, read_arguments
from wasp_cli.operators.base import Operator


class Assist:
    """A trained denoiser at one forward diffusion ratio."""

    def __init__(
        self, denoiser: Denoiser, schedule: NoiseSchedule, ratio: float, last_noise: bool = False
    ) -> None:
        self.denoiser, self.schedule, self.last_noise = denoiser, schedule, last_noise
        self.k = schedule.forward_level(ratio)

    def __call__(self, features: Tensor, a_h: Tensor, streams: Streams) -> Tensor:
        """Commands [B, A] at features [B, F], diffused and denoised; a stream per row."""
        draws = streams.normal(self.k + 1, a_h.shape[-1]).transpose(0, 1)  # [k + 1, B, A]
        return assist(self.denoiser, self.schedule, features, a_h, self.k, draws, self.last_noise)


def load_assist(
    folder: Path, ratio: float, last_noise: bool = False, device: torch.device = CPU
) -> Assist:
    """Load the denoiser of an artifact of the stage `denoiser`."""
    path = folder / "denoiser.safetensors"
    arguments = read_arguments(path)
    schedule = NoiseSchedule(**arguments.pop("schedule"))
    denoiser = Denoiser(**arguments)
    load_weights(denoiser, path)
    return Assist(denoiser.to(device), schedule.to(device), ratio, last_noise)


class Diffusion:
    """Forward to level k = floor((T - 1) ratio), then the reverse chain k-1 ... 0."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(DiffusionConfig, config)
        self.assist = load_assist(
            parts.inputs["denoiser"], self.config.ratio, self.config.last_noise, parts.device
        )
        self.noise = DecisionNoise(parts.device)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        action = self.assist(latent.features, a_h, self.noise.streams())
        return Decision(
            action, blank_record(len(a_h), GATE_METHOD if self.assist.k else 0, a_h.device)
        )


def assist(
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    features: Tensor,
    a_h: Tensor,
    k: int,
    draws: Tensor,
    last_noise: bool = False,
) -> Tensor:
    """Diffuse a_h [B, A] by k steps and denoise it again; k = 0 returns it bit for bit.

    Args:
        draws: standard normal [k + 1, B, A]; the first diffuses, the others enter the reverse
            steps.
        last_noise: also draw at the last reverse step, as the original does: then no command is
            ever executed as it is.
    """
    if k == 0:
        return a_h
    batch = len(a_h)
    # k diffusion steps have been applied to a sample at index k - 1; the reverse loop undoes the
    # same k steps.
    x = schedule.diffuse(a_h, torch.full((batch,), k - 1, device=a_h.device), draws[0])
    for i in range(k - 1, -1, -1):
        predicted = denoiser(features, x, torch.full((batch,), i, device=a_h.device))
        beta, alpha_bar = schedule.beta[i], schedule.alpha_bar[i]
        x = (x - beta / (1 - alpha_bar).sqrt() * predicted) / (1 - beta).sqrt()
        if i > 0 or last_noise:
            x = x + beta.sqrt() * draws[k - i]
    return x.clamp(-1, 1)
