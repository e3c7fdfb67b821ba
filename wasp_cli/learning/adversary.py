"""The adversary of imagined rollouts: its budget from held-out trajectories, and how it learns to
use it.

Both after LUCID (Seo and Bajcsy 2026). Budget and threshold are conformal quantiles of trajectory
maxima. There adversary and safety policy are trained against each other by SAC; here the policy is
the expert, and stays as it is, so that the gradient of what the gates read, through the whole
rollout, is enough. The density is a Gaussian, and theirs a flow. N rows, H horizon, R rollouts, A
actions.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from wasp_cli.learning.configs.adversary import AdversaryConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.models.adversary import Adversary, DisturbedModel, divergence
from wasp_cli.models.base import Dynamics, Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel

CHUNK = 1024  # rows that are looked at together
DENSITY_ROWS = 20_000  # rows at most from which the Gaussian is estimated


def conformal(maxima: Tensor, alpha: float) -> float:
    """Return the threshold that a new trajectory stays within with probability 1 - alpha at least,
    from the maxima [K] of K exchangeable ones; the largest where K is too small for that.
    """
    rank = math.ceil((len(maxima) + 1) * (1 - alpha))
    return float(maxima.sort().values[min(rank, len(maxima)) - 1])


def per_episode(score: Tensor, episode: Tensor) -> Tensor:
    """Return the maxima [K] of scores [N] over K episodes [N]."""
    _, index = episode.unique(return_inverse=True)
    found = score.new_full((int(index.max()) + 1,), -torch.inf)
    return found.scatter_reduce(0, index, score, "amax")


@torch.no_grad()
def surprise(model: SafetyWorldModel, latents: Latents, recording: Recording) -> Tensor:
    """Return the divergence [N] between what was seen and what was foreseen of it: KL of
    posterior and prior, mean over the variables, of recorded rows with their observations.
    """
    found = []
    for index in torch.arange(len(recording.first)).split(CHUNK):
        h = latents.at(index).h
        seen = model.embed(torch.from_numpy(recording.seen[index.numpy()]))
        found.append(divergence(model.rssm.posterior(h, seen), model.rssm.prior(h)))
    return torch.cat(found)


def calibrate(
    adversary: Adversary,
    model: SafetyWorldModel,
    latents: Latents,
    recording: Recording,
    alpha: float,
) -> dict[str, float]:
    """Set the budget and the threshold of the density from held-out trajectories, and return
    them with what they cover.

    Args:
        latents: of the N held-out rows.
        recording: what the model reads, first and episode of these rows.
    """
    episode = torch.from_numpy(recording.episode)
    inside = torch.from_numpy(
        recording.first == 0
    )  # before the first observation nothing was foreseen
    told = surprise(model, latents, recording)
    surprises = per_episode(told[inside], episode[inside])
    odd = torch.cat(
        [adversary.oddness(latents.at(index)) for index in torch.arange(len(episode)).split(CHUNK)]
    )
    oddest = per_episode(odd, episode)
    adversary.radius.fill_(conformal(surprises, alpha))
    adversary.threshold.fill_(conformal(oddest, alpha))
    return {
        "radius": float(adversary.radius),
        "threshold": float(adversary.threshold),
        "trajectories": float(len(surprises)),
        "covered": float((surprises <= adversary.radius).float().mean()),
        "mean_divergence": float(told[inside].mean()),
        "mean_oddness": float(odd.mean()),
    }


def train_adversary(
    adversary: Adversary,
    model: SafetyWorldModel,
    skills: Skills,
    recording: Recording,
    latents: Latents,
    config: AdversaryConfig,
    gamma_c: float,
    seed: int,
    report: Callable[[float, str], None],
) -> list[dict[str, float]]:
    """Learn to raise the cost that the gates read, within the budget: a command, then the expert,
    for H imagined decisions. Model and policies stay fixed, and no held-out row is seen.

    Commands are recorded ones, the expert's and uniform ones, a third each.

    Returns:
        The curve: means over every 20 updates of the cost with the disturbance.
    """
    against = DisturbedModel(model, adversary)
    optimizer = torch.optim.Adam(adversary.net.parameters(), lr=config.learning_rate)
    source = generator(seed)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    action = torch.from_numpy(recording.action)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    # A disturbance of exactly none has no slope where the network's last layer is zero.
    last = adversary.net[-1]
    assert isinstance(last, torch.nn.Linear)
    torch.nn.init.normal_(last.weight, std=0.01, generator=source)
    for update in range(config.updates):
        row = starts[torch.randint(len(starts), (config.batch,), generator=source)]
        now = latents.at(row)
        command = _commands(skills, now, action[row + 1], source)
        noise = gumbel((config.horizon, config.batch, model.noise_size), source)
        cost = imagined_cost(against, skills, now, command, noise, gamma_c).mean()
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        (-cost).backward()
        torch.nn.utils.clip_grad_norm_(adversary.net.parameters(), 1.0)
        optimizer.step()
        recent.append(cost.detach())
        if update % 20 == 19 or update == config.updates - 1:
            mean = float(torch.stack(recent).mean())
            recent.clear()
            curve.append({"update": update + 1, "cost": mean})
            report(
                (update + 1) / config.updates,
                f"update {update + 1}/{config.updates}, imagined cost {mean:.3f}",
            )
    adversary.eval().requires_grad_(False)
    return curve


def imagined_cost(
    model: Dynamics, skills: Skills, start: Latent, command: Tensor, noise: Tensor, gamma_c: float
) -> Tensor:
    """Return the discounted cost [R] of a command [R, A] and the expert afterwards, for Gumbel
    draws [H, R, Z].
    """
    latent = start
    action = command
    weight = torch.ones(len(command))
    total = torch.zeros(len(command))
    for draws in noise:
        latent = model.imagine(latent, action, draws)
        total = total + weight * model.cost(latent)
        weight = gamma_c * weight * model.continues(latent)
        action = skills.expert(latent.features)
    return total


def _commands(skills: Skills, latent: Latent, recorded: Tensor, source: torch.Generator) -> Tensor:
    with torch.no_grad():
        expert = skills.expert(latent.features)
    uniform = 2 * torch.rand(tuple(recorded.shape), generator=source) - 1
    kinds = torch.stack([recorded, expert, uniform])  # [3, R, A]
    each = torch.arange(len(recorded))
    return kinds[torch.randint(3, (len(recorded),), generator=source), each]


@torch.no_grad()
def effect(
    adversary: Adversary,
    model: SafetyWorldModel,
    skills: Skills,
    start: Latent,
    command: Tensor,
    horizon: int,
    gamma_c: float,
    seed: int,
) -> dict[str, float]:
    """Return the mean cost of commands [R, A] at latents [R] without a disturbance, and with
    shares of the budget, on common draws.
    """
    noise = gumbel((horizon, len(command), model.noise_size), generator(seed))
    found = {}
    for share in (0.0, 0.25, 0.5, 1.0):
        against = DisturbedModel(model, adversary, share)
        cost = imagined_cost(against, skills, start, command, noise, gamma_c)
        found[f"cost_at_{share:g}"] = float(cost.mean())
    return found
