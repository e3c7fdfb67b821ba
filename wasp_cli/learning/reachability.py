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
    """Learn Q of an action once and the fallback afterwards. Model and policies stay fixed.

    Each update uses recorded transitions, whose cost is known, and from the same latents as many
    imagined ones under the recorded, the expert's, uniform and extreme actions. The recorded
    transitions correct errors of the imagination; the imagined ones cover actions that nobody
    executed. The target is that of `danger_target`, with the danger of the fallback from a slow
    copy of the value. After the end of an episode everything is safe.

    Args:
        model: imagines.
        skills: their expert acts in some imagined transitions.
        recording: action, cost, terminal, first and episode of N rows; held-out rows are not
            learned.
        latents: of the N rows.
        config: sizes, updates, discount and rates.
        seed: of all draws but the initial weights.
        report: called every 100 updates with the share that is done and a text.

    Returns:
        The frozen value, and the curve: means of loss and target over every 100 updates.
    """
    # -- networks
    value = SafetyValue(
        model.feature_size, model.action_size, config.hidden, tuple(model.sizes.action_scales)
    )
    slow = copy.deepcopy(value).requires_grad_(False)
    optimizer = torch.optim.Adam(value.parameters(), lr=config.learning_rate, fused=True)

    # -- transitions: row i + 1 holds what was executed at the state of row i, and what came of it
    source = generator(seed)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    action = torch.from_numpy(recording.action)
    cost = torch.from_numpy(recording.cost)
    keep = 1 - torch.from_numpy(recording.terminal)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        # -- sample recorded transitions [B]
        row = starts[torch.randint(len(starts), (config.batch,), generator=source)]
        now = latents.at(row)
        then = latents.at(row + 1)
        executed = action[row + 1]
        features = now.features

        # -- imagine as many others, and compute the targets [2 B] of both
        with torch.no_grad():
            tried = commands(value, skills, features, executed, source)
            noise = gumbel((config.batch, model.noise_size), source)
            imagined = model.imagine(now, tried, noise)
            arrived = torch.cat([then.features, imagined.features])
            goes_on = torch.cat([keep[row + 1], model.continues(imagined)])
            _, safest = slow.fallback(arrived)
            onward = goes_on * (1 - safest) / 2  # danger behind the arrived states
            costs = torch.cat([cost[row + 1], model.cost(imagined)])
            target = danger_target(costs, onward, config.gamma)

        # -- loss
        actions = torch.cat([executed, tried]).unsqueeze(1)
        logits = value.logits(features.repeat(2, 1), actions).squeeze(-1)  # [members, 2 B]
        loss = F.binary_cross_entropy_with_logits(logits, target.expand_as(logits))

        # -- update; the rate is constant for the first half, then falls to a tenth
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

        # -- let the slow copy follow
        with torch.no_grad():
            for target_weight, weight in zip(slow.parameters(), value.parameters(), strict=True):
                target_weight.lerp_(weight, config.slow)

        # -- curve
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
    """Draw an action [B, A] for each row: the recorded one, the expert's, a uniform or an extreme
    one, equally likely.

    Args:
        value: lists the extreme actions.
        skills: their expert acts.
        features: [B, F] of the rows.
        recorded: [B, A] what was executed there.
        source: of all draws.
    """
    batch = len(features)
    uniform = 2 * torch.rand(tuple(recorded.shape), generator=source) - 1
    extreme = value.extremes[torch.randint(len(value.extremes), (batch,), generator=source)]
    kinds = torch.stack([recorded, skills.expert(features), uniform, extreme])  # [4, B, A]
    return kinds[torch.randint(4, (batch,), generator=source), torch.arange(batch)]
