"""Diffusion's denoiser: training on the expert's actions at recorded latents, and how near it
brings commands to them.

After Yoneda et al. 2023. K decisions on held-out episodes, A actions.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from wasp_cli.learning.configs.baselines import DenoiserConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.methods.diffusion import assist
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule

RATIOS = (0.2, 0.3, 0.4, 0.6)  # forward diffusion ratios; at 0 a command stays as it is


def train_denoiser(
    recording: Recording,
    labels: torch.Tensor,
    latents: Latents,
    config: DenoiserConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Denoiser, NoiseSchedule, dict[str, float]]:
    """Predict the noise in diffused expert actions; the averaged weights are what is returned.

    As with the original's option of random behaviour and the expert's labels, the expert's action
    is learned in all recorded states.

    Args:
        recording: recorded rows; held-out ones are not learned.
        labels: the expert's own action at every row [N, A].
    """
    schedule = NoiseSchedule(config.steps, config.beta_min, config.beta_max)
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    denoiser = Denoiser(features, labels.shape[1], config.hidden, config.steps)
    average = copy.deepcopy(denoiser).requires_grad_(False)
    optimizer = torch.optim.Adam(denoiser.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    rows = torch.from_numpy(np.flatnonzero(~recording.held_out(HELD_OUT)))
    smoothed = 1.0
    for update in range(config.updates):
        index = rows[torch.randint(len(rows), (config.batch,), generator=source)]
        half = torch.randint(config.steps, ((config.batch + 1) // 2,), generator=source)
        level = torch.cat([half, config.steps - 1 - half])[: config.batch]  # antithetic pairs
        noise = torch.randn((config.batch, labels.shape[1]), generator=source)
        predicted = denoiser(
            latents.at(index).features, schedule.diffuse(labels[index], level, noise), level
        )
        loss = (predicted - noise).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(denoiser.parameters(), 1.0)
        optimizer.step()
        # The average forgets the first updates: its decay rises with the number of them.
        decay = min(config.ema, (1 + update) / (10 + update))
        with torch.no_grad():
            for old, new in zip(average.parameters(), denoiser.parameters(), strict=True):
                old.lerp_(new, 1 - decay)
        smoothed = 0.98 * smoothed + 0.02 * float(loss.detach())
        if update % 100 == 0:
            report(
                update / config.updates, f"update {update}/{config.updates}, loss {smoothed:.3f}"
            )
    average.eval()
    return average, schedule, {"noise_loss": smoothed, "demonstrations": float(len(rows))}


@torch.inference_mode()
def noise_loss(
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    features: Tensor,
    expert: Tensor,
    source: torch.Generator,
) -> float:
    """Return the mean squared error of the predicted noise over all levels at expert actions
    [K, A]; predicting none at all scores 1.
    """
    level = torch.randint(schedule.steps, (len(expert),), generator=source)
    noise = torch.randn(tuple(expert.shape), generator=source)
    return float(
        (denoiser(features, schedule.diffuse(expert, level, noise), level) - noise).square().mean()
    )


@torch.inference_mode()
def denoiser_quality(
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    features: Tensor,
    expert: Tensor,
    recorded: Tensor,
    source: torch.Generator,
) -> dict[str, dict[str, dict[str, float]]]:
    """Return mean distances by kind of command and ratio: `conformity` to the expert's action,
    `fidelity` to the command (0 is nearest).

    Args:
        denoiser: trained.
        schedule: its levels.
        features: [K, F]
        expert: [K, A] the expert's own action there.
        recorded: [K, A] what an operator executed there.
    """
    uniform = 2 * torch.rand(tuple(expert.shape), generator=source) - 1
    found: dict[str, dict[str, dict[str, float]]] = {}
    for kind, command in (("expert", expert), ("recorded", recorded), ("uniform", uniform)):
        found[kind] = {"0": _distances(command, command, expert)}
        for ratio in RATIOS:
            k = schedule.forward_level(ratio)
            draws = torch.randn((k + 1, *expert.shape), generator=source)
            found[kind][f"{ratio:g}"] = _distances(
                assist(denoiser, schedule, features, command, k, draws), command, expert
            )
    return found


def _distances(executed: Tensor, command: Tensor, expert: Tensor) -> dict[str, float]:
    return {
        "conformity": float((executed - expert).norm(dim=-1).mean()),
        "fidelity": float((executed - command).norm(dim=-1).mean()),
    }
