"""Refit of the reward, cost and continuation heads on prior latents: the last step of world-model training."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.shards import Replay
from wasp_cli.models.world_model import SafetyWorldModel

RATE = 1e-3
"""Initial learning rate; it decays linearly to a tenth."""


def refit_heads(
    model: SafetyWorldModel,
    replay: Replay,
    latents: Latents,
    allowed: NDArray[np.bool_],
    config: WorldModelConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> None:
    """Train the heads on what they will read: prior latents up to `refit_horizon` steps ahead, all else frozen.

    Heads trained jointly overpredict the cost more and more along an imagined rollout (2.3 times at step 15 in a study). Rollouts stop
    counting at the end of their episode, whose own last step counts. Only starts from `allowed` rows [N] are used.
    """
    horizon = config.refit_horizon
    starts = np.flatnonzero(allowed[:-1] & (replay.episode[:-1] == replay.episode[1:]))
    if not len(starts) or not config.refit_updates:
        return
    heads = [*model.reward_head.parameters(), *model.cost_head.parameters(), *model.continue_head.parameters()]
    for parameter in heads:
        parameter.requires_grad_(True)
    optimizer = torch.optim.Adam(heads, lr=RATE)
    device, last = model.mean_image.device, len(replay.first) - 1
    source = generator(seed, device)
    for update in range(config.refit_updates):
        index = starts[torch.randint(len(starts), (config.refit_starts,), generator=source, device=device).cpu().numpy()]
        ahead = index[:, None] + 1 + np.arange(horizon)  # [B, K]
        follow = np.minimum(ahead, last)
        same = (replay.episode[follow] == replay.episode[index][:, None]) & (ahead <= last)
        within = torch.from_numpy(same.astype(np.float32)).to(device)
        fields = (replay.action, replay.reward, replay.cost, replay.terminal)
        action, reward, cost, terminal = (torch.from_numpy(field[follow]).to(device) for field in fields)
        with torch.no_grad():
            start = latents.at(torch.from_numpy(index)).to(device)
            features = roll_prior(model, start, action, source).features
        reward_loss, cost_loss = model.head_losses(features, reward, cost, within)
        continuation_loss = model.continuation_loss(features, terminal, within)
        for group in optimizer.param_groups:
            group["lr"] = RATE * (1 - 0.9 * update / config.refit_updates)
        optimizer.zero_grad(set_to_none=True)
        (reward_loss + cost_loss + continuation_loss).backward()
        optimizer.step()
        if update % 50 == 0:
            report(update / config.refit_updates, f"refit {update}/{config.refit_updates}, cost {float(cost_loss.detach()):.3f}")
    for parameter in heads:
        parameter.requires_grad_(False)
