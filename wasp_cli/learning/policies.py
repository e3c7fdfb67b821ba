"""Latent policies: distillation of the expert checkpoints onto latent features, and on-policy
labelling rounds (DAgger).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from wasp_cli.learning.behaviours import Behaviour, Commander
from wasp_cli.learning.closed_loop import Filter, Loop, run_episodes
from wasp_cli.learning.configs.latent import PoliciesConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.shards import Recording
from wasp_cli.methods.human import HumanOnly
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import PrivilegedPolicy, Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import EpisodeNoise, Operator
from wasp_cli.tasks.base import VectorTask

Report = Callable[[float, str], None]
IMAGINED_TOGETHER = 4096  # rows


class Labelled(NamedTuple):
    """N states, with the action of every expert checkpoint there."""

    filtered: Latents  # modes of the posterior, which operators read in the task
    imagined: Latents  # prior samples of the same states, which operators read in imagination
    labels: Tensor  # [K, N, A] actions of the K checkpoints

    def rows(self, mask: Tensor) -> Labelled:
        """Select the states of a mask [N]."""
        return Labelled(self.filtered.rows(mask), self.imagined.rows(mask), self.labels[:, mask])

    def at(self, index: Tensor, share: float, source: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return features [B, F] and labels [K, B, A] of some rows [B]; a share of the features is
        imagined.
        """
        filtered = self.filtered.at(index).features
        imagined = self.imagined.at(index).features
        mask = torch.rand(len(index), 1, generator=source) < share
        return torch.where(mask, imagined, filtered), self.labels[:, index]


def label(
    model: SafetyWorldModel,
    experts: Sequence[PrivilegedPolicy],
    recording: Recording,
    latents: Latents,
    depth: int,
    seed: int,
) -> Labelled:
    """Label every row with the actions of all checkpoints.

    Args:
        model: imagines the rows.
        experts: the K checkpoints.
        recording: privileged, action and first of N rows.
        latents: filtered latents of the N rows.
        depth: imagined rows lie 1 to this many prior steps after a recorded latent.
        seed: of the imagined rows.
    """
    privileged = torch.from_numpy(recording.privileged)
    with torch.no_grad():
        labels = torch.stack([expert(privileged) for expert in experts])
    imagined = imagine_arrivals(
        model,
        latents,
        torch.from_numpy(recording.action),
        torch.from_numpy(recording.first),
        depth,
        seed,
    )
    return Labelled(latents, imagined, labels)


@torch.no_grad()
def imagine_arrivals(
    model: SafetyWorldModel, latents: Latents, action: Tensor, first: Tensor, depth: int, seed: int
) -> Latents:
    """Draw a prior sample of every row's latent: imagined 1 to `depth` steps under the recorded
    actions, never across the start of an episode.

    Args:
        model: imagines.
        latents: filtered latents of N rows, by arrival.
        action: [N, A] the action that led to each row.
        first: [N] in {0, 1}; the first row of an episode stays as it was filtered.
        depth: most imagined steps.
        seed: of all draws.
    """
    # -- how many steps are imagined for each row: not more than its episode has before it
    source = generator(seed)
    rows = torch.arange(len(first))
    start = torch.where(first > 0, rows, torch.zeros_like(rows)).cummax(0).values
    past = rows - start
    steps = torch.minimum(torch.randint(1, depth + 1, (len(first),), generator=source), past)

    # -- imagine rows of the same number of steps together
    h = latents.h.clone()
    z = latents.z.clone()
    for count in range(1, depth + 1):
        for index in rows[steps == count].split(IMAGINED_TOGETHER):
            path = index.unsqueeze(1) - count + 1 + torch.arange(count)  # [n, count] rows
            arrived = roll_prior(model, latents.at(index - count), action[path], source)
            classes = arrived.z[:, -1].unflatten(-1, (-1, latents.classes)).argmax(-1)
            h[index] = arrived.h[:, -1].to(h.dtype)
            z[index] = classes.to(torch.uint8)
    return Latents(h, z, latents.classes)


def new_skills(
    experts: Sequence[PrivilegedPolicy],
    fractions: Sequence[float],
    features: int,
    config: PoliciesConfig,
) -> Skills:
    """Build untrained latent policies, one for each checkpoint of an expert, which explore as the
    last checkpoint does.
    """
    skills = Skills(fractions, features, config.hidden, len(experts[-1].log_std))
    skills.exploration.copy_(experts[-1].log_std.exp())
    return skills


def fit(
    skills: Skills,
    recorded: Labelled,
    visited: Sequence[Labelled],
    updates: int,
    config: PoliciesConfig,
    seed: int,
    report: Report,
) -> None:
    """Regress the actions of every checkpoint on the latents.

    Args:
        skills: trained in place, frozen afterwards.
        recorded: labelled rows of the dataset.
        visited: labelled rows of the rounds so far; together they are `labelled_share` of a batch.
        updates: gradient steps.
        config: batch, rate and shares.
        seed: of all draws.
        report: called every 50 updates with the share that is done and a text.
    """
    skills.train().requires_grad_(True)
    optimizer = torch.optim.Adam(skills.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    rounds = _joined(visited)
    rounds_batch = 0
    if rounds is not None:
        rounds_batch = round(config.labelled_share * config.batch)
    recorded_batch = config.batch - rounds_batch
    for update in range(updates):
        # -- sample states: from the dataset, and from the rounds
        index = torch.randint(recorded.labels.shape[1], (recorded_batch,), generator=source)
        features, labels = recorded.at(index, config.imagined_share, source)
        if rounds is not None and rounds_batch:
            index = torch.randint(rounds.labels.shape[1], (rounds_batch,), generator=source)
            round_features, round_labels = rounds.at(index, config.imagined_share, source)
            features = torch.cat([features, round_features])
            labels = torch.cat([labels, round_labels], 1)

        # -- loss: the sum over the checkpoints
        errors = [
            F.smooth_l1_loss(skills.at(fraction).unbounded(features), labels[k])
            for k, fraction in enumerate(skills.fractions)
        ]
        loss = torch.stack(errors).sum()

        # -- update at a falling rate
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 - 0.95 * update / updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if update % 50 == 0:
            report(update / updates, f"update {update}/{updates}, loss {float(loss.detach()):.3f}")
    skills.eval().requires_grad_(False)


def _joined(parts: Sequence[Labelled]) -> Labelled | None:
    """Concatenate the states of all parts; None without a part."""
    if not parts:
        return None
    return Labelled(
        _joined_latents([part.filtered for part in parts]),
        _joined_latents([part.imagined for part in parts]),
        torch.cat([part.labels for part in parts], 1),
    )


def _joined_latents(parts: Sequence[Latents]) -> Latents:
    h = torch.cat([part.h for part in parts])
    z = torch.cat([part.z for part in parts])
    return Latents(h, z, parts[0].classes)


@torch.no_grad()
def explained(skills: Skills, states: Labelled) -> dict[str, dict[str, float]]:
    """Return R2 of each policy: the share of the variance of its labels that it explains.

    Returns:
        By checkpoint, R2 on `filtered` and on `imagined` latents.
    """
    shares: dict[str, dict[str, float]] = {f"{fraction:g}": {} for fraction in skills.fractions}
    for name, latents in (("filtered", states.filtered), ("imagined", states.imagined)):
        features = latents.at(torch.arange(states.labels.shape[1])).features
        for k, fraction in enumerate(skills.fractions):
            error = (skills.at(fraction)(features) - states.labels[k]).square().mean()
            variance = states.labels[k].var(0, correction=0).mean().clamp(min=1e-9)
            shares[f"{fraction:g}"][name] = float(1 - error / variance)
    return shares


@torch.no_grad()
def agreement(skills: Skills, states: Labelled) -> dict[str, float]:
    """Return how alike each policy acts on filtered and on imagined latents of the same states:
    1 - mean squared difference / variance of its actions, by checkpoint.

    Operators act on both kinds of latents. `explained` does not show this of a reinforced policy:
    it has met the filtered ones only, and no longer follows the labels.
    """
    index = torch.arange(states.labels.shape[1])
    filtered = states.filtered.at(index).features
    imagined = states.imagined.at(index).features
    shares = {}
    for fraction in skills.fractions:
        on_filtered = skills.at(fraction)(filtered)
        on_imagined = skills.at(fraction)(imagined)
        difference = (on_filtered - on_imagined).square().mean()
        variance = on_filtered.var(0, correction=0).mean().clamp(min=1e-9)
        shares[f"{fraction:g}"] = float(1 - difference / variance)
    return shares


def drivers(episodes: int, checkpoints: int, share: float) -> list[Behaviour]:
    """Choose who drives each of the episodes of a labelling round.

    The latent expert drives `1 - share` of them. The others are driven in turn by the expert with
    the mistakes of impaired operators, and by the earlier checkpoints: operators reach the states
    of both.
    """
    others = [
        Behaviour("gaussian", gaussian=0.25),
        Behaviour("noisy", replace=0.3),
        Behaviour("laggy", repeat=0.7),
    ]
    others += [Behaviour(f"skill {k}", skill=k) for k in reversed(range(checkpoints - 1))]
    other_count = round(share * episodes)
    rows = [Behaviour("expert")] * (episodes - other_count)
    rows += [others[i % len(others)] for i in range(other_count)]
    return rows


class _Visit(NamedTuple):
    """B episodes at one decision of a labelling round."""

    privileged: NDArray[np.float32]  # [B, P]
    action: NDArray[np.float32]  # [B, A] what led there
    latent: Latent  # [B, .]
    alive: NDArray[np.bool_]  # [B] the episode was still going


@torch.inference_mode()
def visit(
    task: VectorTask,
    model: SafetyWorldModel,
    skills: Skills,
    rows: Sequence[Behaviour],
    seeds: Sequence[int],
    seed: int,
    report: Report,
) -> tuple[Recording, Latents]:
    """Drive one episode per row through the filter, and keep every state at which a decision was
    made.

    Args:
        task: B episodes with what the model reads and privileged observations.
        model: filters.
        skills: latent policies, which drive.
        rows: [B] who drives which episode.
        seeds: [B] of the worlds.
        seed: of the drivers' mistakes.
        report: called every 25 decisions with the share of the time limit and a text.

    Returns:
        Rows by arrival, episode after episode (privileged, action, first and episode; the other
        columns are empty), and their latents.
    """
    # -- drive
    actors: list[Any] = [skills.at(fraction) for fraction in skills.fractions]
    commander = Commander(actors, rows, task.action_size, np.random.default_rng(seed))
    filter_ = Filter(model, task.batch)
    observation = task.reset(seeds)
    first = torch.ones(task.batch)
    action = np.zeros((task.batch, task.action_size), np.float32)
    ended = np.zeros(task.batch, bool)
    visits: list[_Visit] = []
    for t in range(task.max_decisions):
        assert observation.privileged is not None
        latent = filter_.see(observation, first)
        first = torch.zeros(task.batch)
        visits.append(_Visit(observation.privileged, action, latent, ~ended))
        action = commander.command(latent.features.numpy())
        filter_.executed(torch.from_numpy(action))
        step = task.step(action)
        observation = step.observation
        ended = step.ended.copy()
        if t % 25 == 0:
            report((t + 1) / task.max_decisions, f"decision {t + 1}/{task.max_decisions}")
        if ended.all():
            break

    # -- one row after the other, without those after the end of an episode
    alive = np.stack([one.alive for one in visits], 1)  # [B, T]
    is_first = np.broadcast_to(np.arange(alive.shape[1]) == 0, alive.shape)
    empty: NDArray[np.float32] = np.zeros(0, np.float32)
    columns: dict[str, NDArray[Any]] = dict.fromkeys(Recording._fields, empty)
    columns["privileged"] = np.stack([one.privileged for one in visits], 1)[alive]
    columns["action"] = np.stack([one.action for one in visits], 1)[alive]
    columns["first"] = is_first[alive].astype(np.float32)
    columns["episode"] = np.repeat(np.arange(len(alive), dtype=np.int32), alive.sum(1))

    mask = torch.from_numpy(alive)
    h = torch.stack([one.latent.h for one in visits], 1)[mask].clone()
    z = torch.stack([one.latent.z for one in visits], 1)[mask]
    classes = model.sizes.classes
    indices = z.unflatten(-1, (-1, classes)).argmax(-1).to(torch.uint8).clone()
    return Recording(**columns), Latents(h, indices, classes)


def latent_episodes(
    task: VectorTask, model: SafetyWorldModel, skills: Skills, fraction: float, seeds: Sequence[int]
) -> Loop:
    """Run an episode per seed of the latent policy of one checkpoint, without mistakes and without
    assistance.
    """
    operator = Operator(skills.at(fraction), task.action_size, EpisodeNoise(seeds), task.batch)
    return run_episodes(task, model, operator, HumanOnly(), seeds, seeds)
