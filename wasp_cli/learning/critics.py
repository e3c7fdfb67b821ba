"""Critics: V_r and V_c of the nominal expert, from imagined rollouts (Eq. 7-8) and from
recorded transitions.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from wasp_cli.learning.configs.latent import CriticsConfig
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.recorded_values import Segments, recorded_values
from wasp_cli.learning.sampling import generator, gumbel, roll_prior
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.methods.wasp.returns import td_lambda_all
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.seeds import derive

Q_SHARE = 0.3  # share of the progress that Q takes


def starts_of(recording: Recording) -> Tensor:
    """Return the indices [S] of the recorded rows from which imagination may begin: never held
    out or after an episode's own end.
    """
    return torch.from_numpy(
        np.flatnonzero((recording.terminal == 0) & ~recording.held_out(HELD_OUT))
    )


class Rollout(NamedTuple):
    """H imagined steps of B rows under the expert."""

    features: Tensor  # [H, B, F] where each step began
    arrived: Latent  # fields [H, B, .]
    reward: Tensor  # [H, B] at the arrived states, as the next two
    cost: Tensor
    keep: Tensor  # probability that the episode goes on

    def weight(self) -> Tensor:
        """Return the probability [H, B] that the episode had not ended before the step began."""
        return torch.cat([torch.ones_like(self.keep[:1]), self.keep[:-1]]).cumprod(0)


def train_critics(
    model: SafetyWorldModel,
    skills: Skills,
    recording: Recording,
    latents: Latents,
    config: CriticsConfig,
    returns: ReturnsConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[LatentCritics, list[dict[str, float]]]:
    """Evaluate the expert; model and policy stay fixed, and no held-out row is seen.

    From filtered latents the expert is imagined for H steps, and the critics learn the TD-lambda
    returns of these rollouts, with slow critics behind them. Imagined rewards and costs drift with
    every step, and so do critics that learn from nothing else. Where `config.recorded` says so,
    they therefore also learn at recorded rows what Q says from recorded transitions (see
    `recorded_values`): at the filtered latent, and at those that the prior imagines for the same
    row under the recorded actions, since a planner reads V there.

    Args:
        recording: action, reward, cost, terminal, first and episode of the recorded rows.

    Returns:
        The frozen critics, and the curve: rows of the losses of Q per 100 updates, then a row per
            20 updates of the critics: means of the
        losses and of the imagined targets over these updates.
    """
    curve: list[dict[str, float]] = []
    begun, segments = 0.0, None
    if config.recorded:
        begun = Q_SHARE
        values, curve = recorded_values(
            skills,
            recording,
            latents,
            config,
            returns,
            derive("recorded-values", seed),
            lambda share, text: report(Q_SHARE * share, text),
        )
        segments = Segments(recording, values, config.horizon)
    critics = LatentCritics(model.feature_size, config.hidden, config.bins, config.reach)
    slow = copy.deepcopy(critics).requires_grad_(False)
    optimizer = torch.optim.Adam(critics.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    starts = starts_of(recording)
    recent: list[Tensor] = []
    for update in range(config.updates):
        with torch.no_grad():
            index = starts[torch.randint(len(starts), (config.starts,), generator=source)]
            rollout = imagine(model, skills, latents.at(index), config.horizon, source)
            value_r, value_c = slow.value_r(rollout.arrived), slow.value_c(rollout.arrived)
            target_r = td_lambda_all(
                rollout.reward, value_r, returns.gamma_r, returns.lam, rollout.keep
            )
            target_c = td_lambda_all(
                rollout.cost, value_c, returns.gamma_c, returns.lam, rollout.keep
            )
            weight = rollout.weight()
        loss_r, loss_c = (
            (weight * loss).mean() for loss in critics.losses(rollout.features, target_r, target_c)
        )
        loss, recorded = loss_r + loss_c, torch.zeros(2)
        if segments is not None:
            recorded = _recorded_losses(critics, model, latents, segments, config.starts, source)
            loss = loss + config.recorded * recorded.sum()
        for group in optimizer.param_groups:
            # Constant for the first half, then down to a tenth: the noise of single targets
            # averages out at the end.
            group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(critics.parameters(), 10.0)
        optimizer.step()
        with torch.no_grad():
            for target, online in zip(slow.parameters(), critics.parameters(), strict=True):
                target.lerp_(online, config.slow)
            recent.append(
                torch.stack([loss_r, loss_c, target_r.mean(), target_c.mean(), *recorded])
            )
        if update % 20 == 19 or update == config.updates - 1:
            means = torch.stack(recent).mean(0).tolist()
            recent.clear()
            names = (
                "loss_r",
                "loss_c",
                "target_r",
                "target_c",
                "recorded_loss_r",
                "recorded_loss_c",
            )
            curve.append({"update": update + 1, **dict(zip(names, means, strict=True))})
            told = f"V_r {curve[-1]['target_r']:.2f}, V_c {curve[-1]['target_c']:.3f}"
            report(
                begun + (1 - begun) * (update + 1) / config.updates,
                f"update {update + 1}/{config.updates}, {told}",
            )
    critics.eval().requires_grad_(False)
    return critics, curve


def _recorded_losses(
    critics: LatentCritics,
    model: SafetyWorldModel,
    latents: Latents,
    segments: Segments,
    count: int,
    source: torch.Generator,
) -> Tensor:
    """Score both critics [2] on what Q says of recorded rows: at filtered latents, and at prior
    ones that arrive at the same rows.
    """
    rows, actions, values, counts = segments.sample(count, source)
    with torch.no_grad():
        filtered = latents.at(rows)
        # [B, H + 1, F]
        features = torch.cat(
            [filtered.features.unsqueeze(1), roll_prior(model, filtered, actions, source).features],
            1,
        )
    losses = torch.stack(critics.losses(features, values[0], values[1]))
    scored: Tensor = (losses * counts).sum((1, 2)) / counts.sum()
    return scored


def imagine(
    model: SafetyWorldModel, skills: Skills, start: Latent, horizon: int, source: torch.Generator
) -> Rollout:
    """Imagine H steps under the expert from B latents; the heads read all arrived states at
    once.
    """
    noise = gumbel((horizon, len(start.h), model.noise_size), source)
    features, hs, zs = [], [], []
    latent = start
    for k in range(horizon):
        features.append(latent.features)
        latent = model.imagine(latent, skills.expert(features[-1]), noise[k])
        hs.append(latent.h)
        zs.append(latent.z)
    arrived = Latent(torch.stack(hs), torch.stack(zs))
    return Rollout(
        torch.stack(features),
        arrived,
        model.reward(arrived),
        model.cost(arrived),
        model.continues(arrived),
    )
