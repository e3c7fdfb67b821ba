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

from wasp_cli.learning.closed_loop import Filter, Loop, run_episodes
from wasp_cli.learning.configs.latent import PoliciesConfig
from wasp_cli.learning.dataset import Behaviour, Commander
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


class Labelled(NamedTuple):
    """N states with what every expert checkpoint would do there."""

    filtered: Latents  # the posterior's modes, which operators read in the task
    # prior samples that should have arrived at the same states, which operators read in imagination
    imagined: Latents
    labels: Tensor  # [K, N, A] actions of the K checkpoints

    def rows(self, mask: Tensor) -> Labelled:
        """Select the states of a mask [N]."""
        return Labelled(self.filtered.rows(mask), self.imagined.rows(mask), self.labels[:, mask])

    def at(self, index: Tensor, share: float, source: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return features [B, F] and labels [K, B, A] of some rows; a share of the features is
        imagined.
        """
        seen, dreamt = self.filtered.at(index).features, self.imagined.at(index).features
        mask = torch.rand(len(index), 1, generator=source) < share
        return torch.where(mask, dreamt, seen), self.labels[:, index]


def label(
    model: SafetyWorldModel,
    experts: Sequence[PrivilegedPolicy],
    recording: Recording,
    latents: Latents,
    depth: int,
    seed: int,
) -> Labelled:
    """Ask every checkpoint about every row.

    Args:
        experts: the K checkpoints.
        recording: privileged, action and first of N rows.
        depth: imagined rows lie 1 to this many prior steps after a recorded latent.
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
    """Draw a prior sample of every row's latent: imagined 1..depth steps under the recorded
    actions, never across an episode's start.

    Args:
        latents: of N rows, by arrival.
        action: [N, A] what led to each row.
        first: [N] in {0, 1}; the first row of an episode stays as it was filtered.
    """
    source = generator(seed)
    rows = torch.arange(len(first))
    # rows of the same episode before each
    past = rows - torch.where(first > 0, rows, torch.zeros_like(rows)).cummax(0).values
    steps = torch.minimum(torch.randint(1, depth + 1, (len(first),), generator=source), past)
    h, z = latents.h.clone(), latents.z.clone()
    for count in range(1, depth + 1):
        for index in rows[steps == count].split(4096):
            led = action[index.unsqueeze(1) - count + 1 + torch.arange(count)]  # [n, count, A]
            arrived = roll_prior(model, latents.at(index - count), led, source)
            h[index] = arrived.h[:, -1].to(h.dtype)
            z[index] = (
                arrived.z[:, -1].unflatten(-1, (-1, latents.classes)).argmax(-1).to(torch.uint8)
            )
    return Latents(h, z, latents.classes)


def new_skills(
    experts: Sequence[PrivilegedPolicy],
    fractions: Sequence[float],
    features: int,
    config: PoliciesConfig,
) -> Skills:
    """Build untrained latent policies for the checkpoints of an expert."""
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
    """Regress every checkpoint's action on the latents.

    Args:
        skills: trained in place, frozen afterwards.
        recorded: labelled rows of the dataset.
        visited: labelled rows of the rounds so far; together they are `labelled_share` of a batch.
    """
    skills.train().requires_grad_(True)
    optimizer = torch.optim.Adam(skills.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    later = _joined(visited)
    fresh = round(config.labelled_share * config.batch) if later is not None else 0
    for update in range(updates):
        index = torch.randint(recorded.labels.shape[1], (config.batch - fresh,), generator=source)
        features, labels = recorded.at(index, config.imagined_share, source)
        if later is not None and fresh:
            index = torch.randint(later.labels.shape[1], (fresh,), generator=source)
            more, wanted = later.at(index, config.imagined_share, source)
            features, labels = torch.cat([features, more]), torch.cat([labels, wanted], 1)
        errors = [
            F.smooth_l1_loss(skills.at(f).unbounded(features), labels[k])
            for k, f in enumerate(skills.fractions)
        ]
        loss = torch.stack(errors).sum()
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 - 0.95 * update / updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if update % 50 == 0:
            report(update / updates, f"update {update}/{updates}, loss {float(loss.detach()):.3f}")
    skills.eval().requires_grad_(False)


def _joined(parts: Sequence[Labelled]) -> Labelled | None:
    if not parts:
        return None

    def latents(chosen: Sequence[Latents]) -> Latents:
        return Latents(
            torch.cat([part.h for part in chosen]),
            torch.cat([part.z for part in chosen]),
            chosen[0].classes,
        )

    return Labelled(
        latents([part.filtered for part in parts]),
        latents([part.imagined for part in parts]),
        torch.cat([part.labels for part in parts], 1),
    )


@torch.no_grad()
def explained(skills: Skills, states: Labelled) -> dict[str, dict[str, float]]:
    """Return the share of the labels' variance that each checkpoint's policy explains, on
    filtered and on imagined latents.
    """
    found: dict[str, dict[str, float]] = {}
    for name, latents in (("filtered", states.filtered), ("imagined", states.imagined)):
        features = latents.at(torch.arange(states.labels.shape[1])).features
        for k, fraction in enumerate(skills.fractions):
            error = (skills.at(fraction)(features) - states.labels[k]).square().mean()
            variance = states.labels[k].var(0, correction=0).mean().clamp(min=1e-9)
            found.setdefault(f"{fraction:g}", {})[name] = float(1 - error / variance)
    return found


@torch.no_grad()
def agreement(skills: Skills, states: Labelled) -> dict[str, float]:
    """Return how alike each policy acts on filtered latents and on imagined ones of the same
    states: the share of its own variance.

    Operators act on both. A reinforced policy has met the filtered ones only, and has left the
    labels that `explained` compares with.
    """
    index = torch.arange(states.labels.shape[1])
    filtered, imagined = states.filtered.at(index).features, states.imagined.at(index).features
    found = {}
    for fraction in skills.fractions:
        mine, theirs = skills.at(fraction)(filtered), skills.at(fraction)(imagined)
        found[f"{fraction:g}"] = float(
            1 - (mine - theirs).square().mean() / mine.var(0, correction=0).mean().clamp(min=1e-9)
        )
    return found


def drivers(episodes: int, checkpoints: int, share: float) -> list[Behaviour]:
    """Choose who drives each episode of a labelling round.

    The latent expert drives `1 - share` of them; the others are driven in turn by the expert with
    the mistakes of impaired operators and by the earlier skills, whose states operators reach too.
    """
    others = [
        Behaviour("gaussian", gaussian=0.25),
        Behaviour("noisy", replace=0.3),
        Behaviour("laggy", repeat=0.7),
    ]
    others += [Behaviour(f"skill {k}", skill=k) for k in reversed(range(checkpoints - 1))]
    other = round(share * episodes)
    return [Behaviour("expert")] * (episodes - other) + [
        others[i % len(others)] for i in range(other)
    ]


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
    """Drive one episode per row through the filter and keep every state at which a decision was
    made.

    Args:
        task: B episodes with what the model reads and privileged observations.
        skills: latent policies, which drive.
        rows: who drives which episode.

    Returns:
        Rows by arrival, episode after episode (privileged, action, first and episode; the other
        columns are empty), and their latents.
    """
    actors: list[Any] = [skills.at(fraction) for fraction in skills.fractions]
    commander = Commander(actors, rows, task.action_size, np.random.default_rng(seed))
    filter_ = Filter(model, task.batch)
    seen, first = task.reset(seeds), torch.ones(task.batch)
    led = np.zeros((task.batch, task.action_size), np.float32)
    ended = np.zeros(task.batch, bool)
    steps: list[tuple[NDArray[np.float32], NDArray[np.float32], Latent, NDArray[np.bool_]]] = []
    for t in range(task.max_decisions):
        assert seen.privileged is not None
        latent = filter_.see(seen, first)
        first = torch.zeros(task.batch)
        steps.append((seen.privileged, led, latent, ~ended))
        led = commander.command(latent.features.numpy())
        filter_.executed(torch.from_numpy(led))
        step = task.step(led)
        seen, ended = step.observation, step.ended.copy()
        if t % 25 == 0:
            report((t + 1) / task.max_decisions, f"decision {t + 1}/{task.max_decisions}")
        if ended.all():
            break
    alive = np.stack([step[3] for step in steps], 1)  # [B, T]
    kept = torch.from_numpy(alive)
    h = torch.stack([step[2].h for step in steps], 1)[kept].clone()
    z = torch.stack([step[2].z for step in steps], 1)[kept]
    empty: NDArray[np.float32] = np.zeros(0, np.float32)
    columns = dict.fromkeys(Recording._fields, empty) | {
        "privileged": np.stack([step[0] for step in steps], 1)[alive],
        "action": np.stack([step[1] for step in steps], 1)[alive],
        "first": np.broadcast_to(np.arange(alive.shape[1]) == 0, alive.shape)[alive].astype(
            np.float32
        ),
        "episode": np.repeat(np.arange(len(alive), dtype=np.int32), alive.sum(1)),
    }
    classes = model.sizes.classes
    return Recording(**columns), Latents(
        h, z.unflatten(-1, (-1, classes)).argmax(-1).to(torch.uint8).clone(), classes
    )


def latent_episodes(
    task: VectorTask, model: SafetyWorldModel, skills: Skills, fraction: float, seeds: Sequence[int]
) -> Loop:
    """Run an episode per seed of one latent skill without mistakes and without assistance."""
    operator = Operator(skills.at(fraction), task.action_size, EpisodeNoise(seeds), task.batch)
    return run_episodes(task, model, operator, HumanOnly(), seeds, seeds)
