"""IDA's Q ensemble: TD learning of Q^{pi_E}(h, z, a) on recorded transitions, impaired ones included."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch

from wasp_cli.learning.configs import EnsembleConfig
from wasp_cli.learning.draws import generator
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.replay import Replay
from wasp_cli.models.ensemble import QEnsemble
from wasp_cli.models.policy import Skills


def train_ensemble(
    skills: Skills,
    replay: Replay,
    latents: Latents,
    config: EnsembleConfig,
    gamma: float,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[QEnsemble, dict[str, float]]:
    """Q of acting once and following the expert afterwards: target r + gamma Q'(s', pi_E(s')).

    Every member has a target network of its own and sees the same transitions; a third of each batch comes from uniformly
    random commands being executed ('noisy', 'bursts', 'random'), so that human-like actions are covered.
    """
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    ensemble = QEnsemble(config.members, features, replay.action.shape[1], config.hidden)
    target = copy.deepcopy(ensemble).requires_grad_(False)
    optimizer = torch.optim.Adam(ensemble.parameters(), lr=config.learning_rate)
    source = generator(seed)
    starts = torch.from_numpy(replay.window_starts(2))
    odd = torch.from_numpy(np.flatnonzero(np.isin(replay.behaviour[starts.numpy()], ["noisy", "bursts", "random"])))
    action, reward = torch.from_numpy(replay.action), torch.from_numpy(replay.reward)
    terminal = torch.from_numpy(replay.terminal)
    loss = torch.zeros(())
    for update in range(config.updates):
        pick = torch.randint(len(starts), (config.batch,), generator=source)
        if len(odd):
            third = config.batch // 3
            pick[:third] = odd[torch.randint(len(odd), (third,), generator=source)]
        index = starts[pick]
        now, then = latents.at(index).features, latents.at(index + 1).features
        with torch.no_grad():
            following = target(then, skills.expert(then)) * (1 - terminal[index + 1])
            wanted = reward[index + 1] + gamma * following  # [K, B]
        loss = torch.nn.functional.smooth_l1_loss(ensemble(now, action[index + 1]), wanted)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            for old, new in zip(target.parameters(), ensemble.parameters(), strict=True):
                old.lerp_(new, config.target_rate)
        if update % 100 == 0:
            report(update / config.updates, f"update {update}/{config.updates}, loss {float(loss.detach()):.4f}")
    ensemble.eval().requires_grad_(False)
    return ensemble, {"td_loss": float(loss.detach())}
