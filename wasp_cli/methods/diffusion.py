"""Diffusion (Yoneda et al. 2023): the command is partly diffused and denoised toward the expert's actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.methods.base import Decision, Parts
from wasp_cli.methods.configs import DiffusionConfig
from wasp_cli.methods.noise import DecisionNoise, normal
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule
from wasp_cli.models.weights import load_weights, read_arguments
from wasp_cli.operators.base import Operator


class Diffusion:
    """Forward to level k = floor((T - 1) ratio), then the reverse chain k-1 ... 0 without noise at its last step."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.config = cast(DiffusionConfig, config)
        path = parts.inputs["denoiser"] / "denoiser.safetensors"
        arguments = read_arguments(path)
        self.schedule = NoiseSchedule(**arguments.pop("schedule"))
        self.denoiser = Denoiser(**arguments)
        load_weights(self.denoiser, path)
        self.noise = DecisionNoise()

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self.noise.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        k = self.schedule.forward_level(self.config.ratio)
        draws = normal(self.noise.next(), k + 1, a_h.shape[-1]).transpose(0, 1)  # [k + 1, B, A]
        action = assist(self.denoiser, self.schedule, latent.features, a_h, k, draws)
        return Decision(action, blank_record(len(a_h), GATE_METHOD if k else 0))


def assist(denoiser: Denoiser, schedule: NoiseSchedule, features: Tensor, a_h: Tensor, k: int, draws: Tensor) -> Tensor:
    """Diffuse a_h [B, A] by k steps and denoise it again; k = 0 returns it bit for bit.

    Args:
        draws: standard normal [k + 1, B, A]; the first diffuses, the others enter the reverse steps.
    """
    if k == 0:
        return a_h
    batch = len(a_h)
    # k diffusion steps have been applied to a sample at index k - 1; the reverse loop undoes the same k steps.
    x = schedule.diffuse(a_h, torch.full((batch,), k - 1), draws[0])
    for i in range(k - 1, -1, -1):
        predicted = denoiser(features, x, torch.full((batch,), i))
        beta, alpha_bar = schedule.beta[i], schedule.alpha_bar[i]
        x = (x - beta / (1 - alpha_bar).sqrt() * predicted) / (1 - beta).sqrt()
        if i > 0:
            x = x + beta.sqrt() * draws[k - i]
    return x.clamp(-1, 1)
