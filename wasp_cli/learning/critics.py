"""Critics: V_r and V_c of the nominal expert, from imagined rollouts (Eq. 7-8) and from recorded
transitions. B rows of a batch, H imagined steps, F features.
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

Q_SHARE = 0.3  # share of the progress that the training of Q takes
CURVE = ("loss_r", "loss_c", "target_r", "target_c", "recorded_loss_r", "recorded_loss_c")
"""Columns of the curve of the critics, beside `update`."""


def starts_of(recording: Recording) -> Tensor:
    """Return the recorded rows [S] from which imagination may begin: those that are not held out
    and at which no episode ended by its task's own rule.
    """
    goes_on = recording.terminal == 0
    return torch.from_numpy(np.flatnonzero(goes_on & ~recording.held_out(HELD_OUT)))


class Rollout(NamedTuple):
    """H imagined steps of B rows under the expert."""

    features: Tensor  # [H, B, F] where each step began
    arrived: Latent  # fields [H, B, .] where it arrived
    reward: Tensor  # [H, B] at the arrived states
    cost: Tensor  # [H, B] probability of a cost there
    keep: Tensor  # [H, B] probability that the episode goes on from there

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
    """Learn the value of the expert. Model and policy stay fixed.

    From filtered latents the expert is imagined for H steps, and the critics learn the TD-lambda
    returns of these rollouts, which end in the values of slow critics. Imagined rewards and costs
    drift with every step, and so do critics that learn from nothing else. With `config.recorded`
    above 0 they therefore also learn, at recorded rows, the Q of recorded transitions (see
    `recorded_values`): at the filtered latent, and at latents that the prior imagines for the same
    row under the recorded actions, because a planner reads V at such latents.

    Args:
        model: imagines.
        skills: their expert is evaluated.
        recording: action, reward, cost, terminal, first and episode of N rows; held-out rows are
            not learned.
        latents: of the N rows.
        config: sizes, updates and rates.
        returns: discounts and lambda.
        seed: of all draws but the initial weights.
        report: called with the share that is done and a text.

    Returns:
        The frozen critics, and the curve: rows of the losses of Q per 100 updates, then a row per
        20 updates of the critics, with means of the losses and of the imagined targets.
    """
    # -- Q of recorded transitions
    curve: list[dict[str, float]] = []
    segments: Segments | None = None
    q_share = 0.0
    if config.recorded:
        q_share = Q_SHARE

        def report_q(share: float, text: str) -> None:
            report(Q_SHARE * share, text)

        values, curve = recorded_values(
            skills, recording, latents, config, returns, derive("recorded-values", seed), report_q
        )
        segments = Segments(recording, values, config.horizon)

    # -- networks
    critics = LatentCritics(model.feature_size, config.hidden, config.bins, config.reach)
    slow = copy.deepcopy(critics).requires_grad_(False)
    optimizer = torch.optim.Adam(critics.parameters(), lr=config.learning_rate, fused=True)

    source = generator(seed)
    starts = starts_of(recording)
    recent: list[Tensor] = []
    for update in range(config.updates):
        # -- imagine the expert from recorded rows, and compute the targets [H, B]
        with torch.no_grad():
            index = starts[torch.randint(len(starts), (config.starts,), generator=source)]
            rollout = imagine(model, skills, latents.at(index), config.horizon, source)
            value_r = slow.value_r(rollout.arrived)
            value_c = slow.value_c(rollout.arrived)
            target_r = td_lambda_all(
                rollout.reward, value_r, returns.gamma_r, returns.lam, rollout.keep
            )
            target_c = td_lambda_all(
                rollout.cost, value_c, returns.gamma_c, returns.lam, rollout.keep
            )
            weight = rollout.weight()

        # -- losses on imagined targets, and on recorded ones
        errors_r, errors_c = critics.losses(rollout.features, target_r, target_c)
        loss_r = (weight * errors_r).mean()
        loss_c = (weight * errors_c).mean()
        loss = loss_r + loss_c
        recorded_losses = torch.zeros(2)
        if segments is not None:
            recorded_losses = _recorded_losses(
                critics, model, latents, segments, config.starts, source
            )
            loss = loss + config.recorded * recorded_losses.sum()

        # -- update; the rate is constant for the first half, then falls to a tenth, so that the
        # noise of single targets averages out at the end
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(critics.parameters(), 10.0)
        optimizer.step()

        # -- let the slow critics follow
        with torch.no_grad():
            for target, online in zip(slow.parameters(), critics.parameters(), strict=True):
                target.lerp_(online, config.slow)

        # -- curve
        with torch.no_grad():
            recent.append(
                torch.stack([loss_r, loss_c, target_r.mean(), target_c.mean(), *recorded_losses])
            )
        if update % 20 == 19 or update == config.updates - 1:
            means = torch.stack(recent).mean(0).tolist()
            recent.clear()
            row = dict(zip(CURVE, means, strict=True))
            curve.append({"update": update + 1, **row})
            report(
                q_share + (1 - q_share) * (update + 1) / config.updates,
                f"update {update + 1}/{config.updates}, V_r {row['target_r']:.2f}, V_c "
                f"{row['target_c']:.3f}",
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
    """Return the losses [2] of both critics on the Q of recorded rows: at filtered latents, and at
    prior latents that arrive at the same rows.
    """
    sample = segments.sample(count, source)
    with torch.no_grad():
        filtered = latents.at(sample.rows)
        imagined = roll_prior(model, filtered, sample.actions, source)
        features = torch.cat(
            [filtered.features.unsqueeze(1), imagined.features], 1
        )  # [B, H + 1, F]
    errors = torch.stack(critics.losses(features, sample.values[0], sample.values[1]))
    losses: Tensor = (errors * sample.counts).sum((1, 2)) / sample.counts.sum()
    return losses


def imagine(
    model: SafetyWorldModel, skills: Skills, start: Latent, horizon: int, source: torch.Generator
) -> Rollout:
    """Imagine H steps under the expert from B latents. The heads read all arrived states
    together.
    """
    noise = gumbel((horizon, len(start.h), model.noise_size), source)
    features: list[Tensor] = []
    steps: list[Latent] = []
    latent = start
    for k in range(horizon):
        features.append(latent.features)
        latent = model.imagine(latent, skills.expert(features[-1]), noise[k])
        steps.append(latent)
    h = torch.stack([step.h for step in steps])
    z = torch.stack([step.z for step in steps])
    arrived = Latent(h, z)
    return Rollout(
        torch.stack(features),
        arrived,
        model.reward(arrived),
        model.cost(arrived),
        model.continues(arrived),
    )
