"""Reachability: the safety value Q(h, z, a) by the discounted safety Bellman equation, on
recorded transitions and on imagined ones.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from wasp_cli.learning.configs.reachability import ReachabilityConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.models.policy import Skills
from wasp_cli.models.reachability import SafetyValue, danger_target
from wasp_cli.models.world_model import SafetyWorldModel


def train_safety_value(
    model: SafetyWorldModel,
    skills: Skills,
    recording: Recording,
    latents: Latents,
    config: ReachabilityConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[SafetyValue, list[dict[str, float]]]:
    """Learn Q of an action once and the fallback afterwards; model and policies stay fixed, and no
    held-out row is seen.

    Each update sees recorded transitions, whose cost is known, and from the same latents as many
    imagined ones under actions of many kinds: an operator's, the expert's, uniform and extreme
    ones. The recorded ones keep the imagination honest, and the imagined ones say what nobody did.
    The target is that of `danger_target`, with the fallback's danger from a slow copy, and what
    lies behind the end of an episode is safe.

    Args:
        recording: action, cost, terminal and episode of the recorded rows.

    Returns:
        The frozen value, and the curve: means of loss and target over every 100 updates.
    """
    value = SafetyValue(
        model.feature_size, model.action_size, config.hidden, tuple(model.sizes.action_scales)
    )
    slow = copy.deepcopy(value).requires_grad_(False)
    optimizer = torch.optim.Adam(value.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    action, cost = torch.from_numpy(recording.action), torch.from_numpy(recording.cost)
    keep = 1 - torch.from_numpy(recording.terminal)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        row = starts[torch.randint(len(starts), (config.batch,), generator=source)]
        now, then, did = latents.at(row), latents.at(row + 1), action[row + 1]
        with torch.no_grad():
            features = now.features
            tried = commands(value, skills, features, did, source)
            found = model.imagine(now, tried, gumbel((config.batch, model.noise_size), source))
            arrived = torch.cat([then.features, found.features])
            goes_on = torch.cat([keep[row + 1], model.continues(found)])
            onward = goes_on * (1 - slow.fallback(arrived)[1]) / 2
            target = danger_target(
                torch.cat([cost[row + 1], model.cost(found)]), onward, config.gamma
            )
        # [members, 2 B]
        logits = value.logits(features.repeat(2, 1), torch.cat([did, tried]).unsqueeze(1)).squeeze(
            -1
        )
        loss = F.binary_cross_entropy_with_logits(logits, target.expand_as(logits))
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            for old, new in zip(slow.parameters(), value.parameters(), strict=True):
                old.lerp_(new, config.slow)
            recent.append(torch.stack([loss.detach(), target.mean()]))
        if update % 100 == 99 or update == config.updates - 1:
            means = torch.stack(recent).mean(0).tolist()
            recent.clear()
            curve.append({"update": update + 1, "loss": means[0], "danger": means[1]})
            report(
                (update + 1) / config.updates,
                f"update {update + 1}/{config.updates}, loss {means[0]:.3f}, danger {means[1]:.3f}",
            )
    value.eval().requires_grad_(False)
    return value, curve


def commands(
    value: SafetyValue, skills: Skills, features: Tensor, recorded: Tensor, source: torch.Generator
) -> Tensor:
    """Draw an action [B, A] for each row: the recorded one, the expert's, a uniform one or an
    extreme one, by chance.
    """
    batch = len(features)
    uniform = 2 * torch.rand(tuple(recorded.shape), generator=source) - 1
    extreme = value.extremes[torch.randint(len(value.extremes), (batch,), generator=source)]
    kinds = torch.stack([recorded, skills.expert(features), uniform, extreme])  # [4, B, A]
    return kinds[torch.randint(4, (batch,), generator=source), torch.arange(batch)]
