"""Distillation of the expert checkpoints onto latent features."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch.nn import functional as F

from wasp_cli.learning.configs import PoliciesConfig
from wasp_cli.learning.draws import generator
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.replay import Replay
from wasp_cli.models.policy import PrivilegedPolicy, Skills
from wasp_cli.models.weights import load_weights, read_arguments, save_weights


def distil(
    experts: Sequence[PrivilegedPolicy],
    fractions: Sequence[float],
    replay: Replay,
    latents: Latents,
    config: PoliciesConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Skills, dict[str, float]]:
    """Regress every checkpoint's action on the latents of all recorded states.

    Returns:
        The policies, and per checkpoint the share of the labels' variance that they explain on the last tenth of the rows.
    """
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    action = replay.action.shape[1]
    skills = Skills(fractions, features, config.hidden, action)
    skills.exploration.copy_(experts[-1].log_std.exp())
    privileged = torch.from_numpy(replay.privileged)
    with torch.no_grad():
        labels = torch.stack([expert(privileged) for expert in experts])  # [K, N, A]
    train = int(0.9 * len(privileged))
    optimizer = torch.optim.Adam(skills.parameters(), lr=config.learning_rate)
    source = generator(seed)
    for update in range(config.updates):
        index = torch.randint(train, (config.batch,), generator=source)
        seen = latents.at(index).features
        loss = torch.stack([F.smooth_l1_loss(skills.at(f).unbounded(seen), labels[k, index]) for k, f in enumerate(fractions)]).sum()
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 - 0.95 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if update % 50 == 0:
            report(update / config.updates, f"update {update}/{config.updates}, loss {float(loss.detach()):.3f}")
    skills.eval().requires_grad_(False)
    rest = torch.arange(train, len(privileged))
    seen = latents.at(rest).features
    explained = {}
    for k, fraction in enumerate(fractions):
        error = (skills.at(fraction)(seen) - labels[k, rest]).square().mean()
        explained[f"{fraction:g}"] = float(1 - error / labels[k, rest].var(0, correction=0).mean().clamp(min=1e-9))
    return skills, explained


def save_skills(skills: Skills, folder: Path, features: int, hidden: Sequence[int], action: int) -> None:
    """Write `skills.safetensors` and its arguments."""
    path = folder / "skills.safetensors"
    save_weights(skills, path, fractions=list(skills.fractions), features=features, hidden=list(hidden), action=action)


def load_skills(folder: Path) -> Skills:
    """The frozen policies of a policies artifact."""
    path = folder / "skills.safetensors"
    skills = Skills(**read_arguments(path))
    load_weights(skills, path)
    return skills
