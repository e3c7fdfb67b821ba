"""Diffusion's denoiser: training on the expert's actions at recorded latents, and how near it
brings commands to these actions.

After Yoneda et al. 2023. K decisions of held-out episodes, A components of an action.
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

RATIOS = (0.2, 0.3, 0.4, 0.6)  # forward diffusion ratios; at 0 a command is not changed


def train_denoiser(
    recording: Recording,
    labels: torch.Tensor,
    latents: Latents,
    config: DenoiserConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Denoiser, NoiseSchedule, dict[str, float]]:
    """Learn to predict the noise in diffused expert actions.

    The expert's action is learned in all recorded states, whoever drove there: the option of the
    original with random behaviour and the expert's labels.

    Args:
        recording: N recorded rows; held-out ones are not learned.
        labels: [N, A] the expert's own action at every row.
        latents: of the N rows.
        config: schedule, sizes, updates and rates.
        seed: of all draws but the initial weights.
        report: called every 100 updates with the share that is done and a text.

    Returns:
        The denoiser with its averaged weights, its schedule, and numbers of the training.
    """
    # -- network, with an average of its weights
    schedule = NoiseSchedule(config.steps, config.beta_min, config.beta_max)
    denoiser = Denoiser(latents.features, labels.shape[1], config.hidden, config.steps)
    average = copy.deepcopy(denoiser).requires_grad_(False)
    optimizer = torch.optim.Adam(denoiser.parameters(), lr=config.learning_rate, fused=True)

    source = generator(seed)
    rows = torch.from_numpy(np.flatnonzero(~recording.held_out(HELD_OUT)))
    smoothed = 1.0
    for update in range(config.updates):
        # -- sample states [B], levels in antithetic pairs, and noise
        index = rows[torch.randint(len(rows), (config.batch,), generator=source)]
        half = torch.randint(config.steps, ((config.batch + 1) // 2,), generator=source)
        level = torch.cat([half, config.steps - 1 - half])[: config.batch]
        noise = torch.randn((config.batch, labels.shape[1]), generator=source)

        # -- loss
        diffused = schedule.diffuse(labels[index], level, noise)
        predicted = denoiser(latents.at(index).features, diffused, level)
        loss = (predicted - noise).square().mean()

        # -- update
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(denoiser.parameters(), 1.0)
        optimizer.step()

        # -- average the weights; the decay rises, so that the first updates are forgotten
        decay = min(config.ema, (1 + update) / (10 + update))
        with torch.no_grad():
            for mean, online in zip(average.parameters(), denoiser.parameters(), strict=True):
                mean.lerp_(online, 1 - decay)

        # -- progress
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
    """Return the mean squared error of the predicted noise over all levels, at features [K, F] and
    expert actions [K, A]. A prediction of zero noise scores 1.
    """
    level = torch.randint(schedule.steps, (len(expert),), generator=source)
    noise = torch.randn(tuple(expert.shape), generator=source)
    predicted = denoiser(features, schedule.diffuse(expert, level, noise), level)
    return float((predicted - noise).square().mean())


@torch.inference_mode()
def denoiser_quality(
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    features: Tensor,
    expert: Tensor,
    recorded: Tensor,
    source: torch.Generator,
) -> dict[str, dict[str, dict[str, float]]]:
    """Return mean distances of denoised commands, by kind of command and diffusion ratio:
    `conformity` is the distance to the expert's action, `fidelity` that to the command.

    Args:
        denoiser: trained.
        schedule: its levels.
        features: [K, F] of the decisions.
        expert: [K, A] the expert's own action there.
        recorded: [K, A] what an operator executed there.
        source: of all draws.
    """
    uniform = 2 * torch.rand(tuple(expert.shape), generator=source) - 1
    commands = {"expert": expert, "recorded": recorded, "uniform": uniform}
    distances: dict[str, dict[str, dict[str, float]]] = {}
    for kind, command in commands.items():
        distances[kind] = {"0": _distances(command, command, expert)}
        for ratio in RATIOS:
            level = schedule.forward_level(ratio)
            draws = torch.randn((level + 1, *expert.shape), generator=source)
            executed = assist(denoiser, schedule, features, command, level, draws)
            distances[kind][f"{ratio:g}"] = _distances(executed, command, expert)
    return distances


def _distances(executed: Tensor, command: Tensor, expert: Tensor) -> dict[str, float]:
    return {
        "conformity": float((executed - expert).norm(dim=-1).mean()),
        "fidelity": float((executed - command).norm(dim=-1).mean()),
    }
