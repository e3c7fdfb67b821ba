"""Diffusion (Yoneda et al. 2023): the command is partly diffused and denoised toward the
expert's actions.

B episodes, A actions, F features, T steps of the schedule, k of them applied.
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
from wasp_cli.metrics.episode import GATE_METHOD, GATE_NONE
from wasp_cli.models.base import Latent
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule
from wasp_cli.models.weights import load_weights, read_arguments
from wasp_cli.operators.base import Operator


class Assist:
    """A trained denoiser at one forward diffusion ratio."""

    def __init__(
        self, denoiser: Denoiser, schedule: NoiseSchedule, ratio: float, last_noise: bool = False
    ) -> None:
        self.denoiser = denoiser
        self.schedule = schedule
        self.last_noise = last_noise
        self.k = schedule.forward_level(ratio)

    def __call__(self, features: Tensor, a_h: Tensor, streams: Streams) -> Tensor:
        """Return commands [B, A] at features [B, F], diffused and denoised; each row draws from a
        stream of its own.
        """
        draws = streams.normal(self.k + 1, a_h.shape[-1]).transpose(0, 1)  # [k + 1, B, A]
        return assist(self.denoiser, self.schedule, features, a_h, self.k, draws, self.last_noise)


def load_assist(
    folder: Path, ratio: float, last_noise: bool = False, device: torch.device = CPU
) -> Assist:
    """Load the denoiser of an artifact of the stage `denoiser`.

    Args:
        folder: of the artifact.
        ratio: forward diffusion ratio, from 0 to 1.
        last_noise: as in `assist`.
        device: where it runs.

    Raises:
        ArtifactError: a file of it cannot be read.
    """
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
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        self.noise.reset(rows, seeds)

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A], diffused and denoised."""
        action = self.assist(latent.features, a_h, self.noise.streams())
        gate = GATE_METHOD if self.assist.k else GATE_NONE
        return Decision(action, blank_record(len(a_h), gate, a_h.device))


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
        denoiser: epsilon(x_k, k | h, z).
        schedule: its T steps.
        features: [B, F].
        a_h: [B, A].
        k: steps, from 0 to T - 1.
        draws: standard normal [k + 1, B, A]; the first diffuses, the others enter the reverse
            steps.
        last_noise: also draw at the last reverse step, as the original does: then no command is
            ever executed as it is.
    """
    if k == 0:
        return a_h

    # Forward. A sample at index k - 1 has been diffused by k steps.
    batch = len(a_h)
    x = schedule.diffuse(a_h, torch.full((batch,), k - 1, device=a_h.device), draws[0])

    # Back: the same k steps.
    for i in range(k - 1, -1, -1):
        predicted = denoiser(features, x, torch.full((batch,), i, device=a_h.device))
        beta = schedule.beta[i]
        alpha_bar = schedule.alpha_bar[i]
        x = (x - beta / (1 - alpha_bar).sqrt() * predicted) / (1 - beta).sqrt()
        if i > 0 or last_noise:
            x = x + beta.sqrt() * draws[k - i]
    return x.clamp(-1, 1)
