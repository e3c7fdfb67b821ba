"""Training of Diffusion's denoiser on the expert's actions at recorded latents."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.errors import TrainingError
from wasp_cli.learning.configs import DenoiserConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import HELD_OUT, Replay
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule


def demonstrations(replay: Replay, config: DenoiserConfig) -> NDArray[np.int64]:
    """Rows whose expert action is learned, without those that are held out: all, or the near-expert episodes within the cost limit.

    When no near-expert episode is within it, the one of least cost has to do.

    Raises:
        TrainingError: there is no near-expert episode.
    """
    learned = ~replay.held_out(HELD_OUT)
    if config.states == "all":
        return np.flatnonzero(learned)
    near = (replay.behaviour == "expert") & learned
    rows = [np.flatnonzero(near & (replay.episode == e)) for e in np.unique(replay.episode[near])]
    if not rows:
        raise TrainingError("the dataset has no near-expert episode", "raise dataset.mixture.expert or dataset.steps")
    rows.sort(key=lambda r: float(replay.cost_env[r].sum()))
    careful = [r for r in rows if replay.cost_env[r].sum() <= config.cost_limit]
    return np.sort(np.concatenate(careful or rows[:1]))


def train_denoiser(
    replay: Replay,
    labels: torch.Tensor,
    latents: Latents,
    config: DenoiserConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Denoiser, NoiseSchedule, dict[str, float]]:
    """Predict the noise in diffused expert actions; the averaged weights are what is returned.

    Args:
        replay: recorded rows.
        labels: the expert's own action at every row [N, A].
        latents: of every row.
        config: sizes and budgets.
        seed: of this training.
        report: called about every 100 updates.
    """
    schedule = NoiseSchedule(config.steps, config.beta_min, config.beta_max)
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    denoiser = Denoiser(features, labels.shape[1], config.hidden, config.steps)
    average = copy.deepcopy(denoiser).requires_grad_(False)
    optimizer = torch.optim.Adam(denoiser.parameters(), lr=config.learning_rate)
    source = generator(seed)
    rows = torch.from_numpy(demonstrations(replay, config))
    smoothed = 1.0
    for update in range(config.updates):
        index = rows[torch.randint(len(rows), (config.batch,), generator=source)]
        half = torch.randint(config.steps, ((config.batch + 1) // 2,), generator=source)
        level = torch.cat([half, config.steps - 1 - half])[: config.batch]  # antithetic pairs
        noise = torch.randn((config.batch, labels.shape[1]), generator=source)
        predicted = denoiser(latents.at(index).features, schedule.diffuse(labels[index], level, noise), level)
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
            report(update / config.updates, f"update {update}/{config.updates}, loss {smoothed:.3f}")
    average.eval()
    return average, schedule, {"noise_loss": smoothed, "demonstrations": float(len(rows))}
