"""The adversary of imagined rollouts: its budget from held-out trajectories, and its training.

Both after LUCID (Seo and Bajcsy 2026). Budget and threshold are conformal quantiles of the maxima
of trajectories. LUCID trains adversary and safety policy against each other by SAC. Here the policy
is the expert and does not change, so the adversary follows the gradient of the cost that the gates
read, through the whole rollout. The density is a Gaussian; in LUCID it is a flow.

N rows, H imagined steps, R rollouts, A components of an action, Z draws of a step.
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

CHUNK = 1024  # rows that are evaluated together
DENSITY_ROWS = 20_000  # rows at most from which the Gaussian is estimated


def conformal(maxima: Tensor, alpha: float) -> float:
    """Return the threshold within which a new trajectory stays with a probability of at least 1 -
    alpha.

    Args:
        maxima: [K] of K exchangeable trajectories. Where K is too small for the probability, the
            largest of them is the threshold.
        alpha: share of the trajectories that may leave it.
    """
    rank = math.ceil((len(maxima) + 1) * (1 - alpha))
    return float(maxima.sort().values[min(rank, len(maxima)) - 1])


def per_episode(score: Tensor, episode: Tensor) -> Tensor:
    """Return the maxima [K] of scores [N] over the K episodes, whose numbers are `episode` [N]."""
    _, index = episode.unique(return_inverse=True)
    maxima = score.new_full((int(index.max()) + 1,), -torch.inf)
    return maxima.scatter_reduce(0, index, score, "amax")


@torch.no_grad()
def surprise(model: SafetyWorldModel, latents: Latents, recording: Recording) -> Tensor:
    """Return how much each of N recorded observations differs from its prediction: the KL [N] of
    posterior and prior, mean over the variables.
    """
    divergences = []
    for index in torch.arange(len(recording.first)).split(CHUNK):
        h = latents.at(index).h
        embedding = model.embed(torch.from_numpy(recording.seen[index.numpy()]))
        posterior = model.rssm.posterior(h, embedding)
        divergences.append(divergence(posterior, model.rssm.prior(h)))
    return torch.cat(divergences)


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
        adversary: its `radius` and `threshold` are set; its density is there already.
        model: of the latents.
        latents: of the N held-out rows.
        recording: what the model reads, first and episode of these rows.
        alpha: share of the trajectories that may leave the budget.

    Returns:
        `radius`, `threshold`, the number of `trajectories`, the share that the budget has
        `covered`, and the means of divergence and oddness over the rows.
    """
    # -- the budget: the largest surprise of a trajectory; its first row has no prediction
    episode = torch.from_numpy(recording.episode)
    predicted = torch.from_numpy(recording.first == 0)
    divergences = surprise(model, latents, recording)
    surprises = per_episode(divergences[predicted], episode[predicted])
    adversary.radius.fill_(conformal(surprises, alpha))

    # -- the threshold of the density: the oddest latent of a trajectory
    parts = torch.arange(len(episode)).split(CHUNK)
    oddness = torch.cat([adversary.oddness(latents.at(index)) for index in parts])
    adversary.threshold.fill_(conformal(per_episode(oddness, episode), alpha))
    return {
        "radius": float(adversary.radius),
        "threshold": float(adversary.threshold),
        "trajectories": float(len(surprises)),
        "covered": float((surprises <= adversary.radius).float().mean()),
        "mean_divergence": float(divergences[predicted].mean()),
        "mean_oddness": float(oddness.mean()),
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
    """Learn to raise the cost that the gates read, within the budget: that of a command and the
    expert afterwards, over H imagined decisions. Model and policies stay fixed.

    A third of the commands each are recorded, the expert's and uniform.

    Args:
        adversary: calibrated; trained in place and frozen.
        model: imagines.
        skills: their expert acts after the command.
        recording: action, first and episode of N rows; held-out rows are not learned.
        latents: of the N rows.
        config: horizon, updates, batch and rate.
        gamma_c: discount of the cost.
        seed: of all draws but the initial weights.
        report: called every 20 updates with the share that is done and a text.

    Returns:
        The curve: the mean cost with the disturbance over every 20 updates.
    """
    disturbed = DisturbedModel(model, adversary)
    optimizer = torch.optim.Adam(adversary.net.parameters(), lr=config.learning_rate)
    source = generator(seed)

    # -- starts: row i + 1 holds what was executed at the state of row i
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    action = torch.from_numpy(recording.action)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []

    # -- a small disturbance at the beginning: where the last layer is zero there is no gradient
    last = adversary.net[-1]
    assert isinstance(last, torch.nn.Linear)
    torch.nn.init.normal_(last.weight, std=0.01, generator=source)

    for update in range(config.updates):
        # -- sample latents, commands and draws
        row = starts[torch.randint(len(starts), (config.batch,), generator=source)]
        now = latents.at(row)
        command = _commands(skills, now, action[row + 1], source)
        noise = gumbel((config.horizon, config.batch, model.noise_size), source)

        # -- imagine with the disturbance
        cost = imagined_cost(disturbed, skills, now, command, noise, gamma_c).mean()

        # -- update towards more cost; the rate is constant for the first half, then falls
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        (-cost).backward()
        torch.nn.utils.clip_grad_norm_(adversary.net.parameters(), 1.0)
        optimizer.step()

        # -- curve
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
    """Return the discounted cost [R] of a command and of the expert after it.

    Args:
        model: imagines.
        skills: their expert acts.
        start: [R, .] latents.
        command: [R, A] the first actions.
        noise: [H, R, Z] Gumbel draws of the imagined steps.
        gamma_c: discount per decision.
    """
    latent = start
    action = command
    weight = torch.ones(len(command))  # discount times the probability of getting there
    total = torch.zeros(len(command))
    for draws in noise:
        latent = model.imagine(latent, action, draws)
        total = total + weight * model.cost(latent)
        weight = gamma_c * weight * model.continues(latent)
        action = skills.expert(latent.features)
    return total


def _commands(skills: Skills, latent: Latent, recorded: Tensor, source: torch.Generator) -> Tensor:
    """Draw a command [R, A] for each row: the recorded one, the expert's or a uniform one."""
    with torch.no_grad():
        expert = skills.expert(latent.features)
    uniform = 2 * torch.rand(tuple(recorded.shape), generator=source) - 1
    kinds = torch.stack([recorded, expert, uniform])  # [3, R, A]
    choice = torch.randint(3, (len(recorded),), generator=source)
    return kinds[choice, torch.arange(len(recorded))]


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
    """Return the mean cost of commands [R, A] at latents [R, .] without a disturbance and with
    shares of the budget, all on the same draws: `cost_at_SHARE`.
    """
    noise = gumbel((horizon, len(command), model.noise_size), generator(seed))
    costs = {}
    for share in (0.0, 0.25, 0.5, 1.0):
        disturbed = DisturbedModel(model, adversary, share)
        cost = imagined_cost(disturbed, skills, start, command, noise, gamma_c)
        costs[f"cost_at_{share:g}"] = float(cost.mean())
    return costs
