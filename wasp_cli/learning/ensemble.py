"""IDA's Q ensemble: TD learning of Q^{pi_E}(h, z, a) on recorded transitions, impaired ones
included.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch

from wasp_cli.learning.configs.baselines import EnsembleConfig
from wasp_cli.learning.critic_quality import Pairs, pairs
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.methods.base import Heldout
from wasp_cli.models.ensemble import QEnsemble
from wasp_cli.models.policy import Skills


def train_ensemble(
    skills: Skills,
    recording: Recording,
    latents: Latents,
    config: EnsembleConfig,
    gamma: float,
    seed: int,
    report: Callable[[float, str], None],
    unit: float = 1.0,
) -> tuple[QEnsemble, list[float]]:
    """Learn Q of acting once and following the expert afterwards: target r + gamma Q'(s',
    pi_E(s')).

    Every member has a target network of its own and sees the same transitions; a third of each
    batch comes from uniformly random commands being executed ('noisy', 'bursts', 'random'), so that
    human-like actions are covered.

    Args:
        unit: in which Q counts rewards: see `learning.reward_unit`.

    Returns:
        The ensemble, and its TD loss at every hundredth update.
    """
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    ensemble = QEnsemble(config.members, features, recording.action.shape[1], config.hidden)
    target = copy.deepcopy(ensemble).requires_grad_(False)
    optimizer = torch.optim.Adam(ensemble.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    odd = torch.from_numpy(
        np.flatnonzero(np.isin(recording.behaviour[starts.numpy()], ["noisy", "bursts", "random"]))
    )
    action = torch.from_numpy(recording.action)
    reward = torch.from_numpy(recording.reward) / unit
    terminal = torch.from_numpy(recording.terminal)
    curve: list[float] = []
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
            curve.append(float(loss.detach()))
            report(
                update / config.updates, f"update {update}/{config.updates}, loss {curve[-1]:.4f}"
            )
    ensemble.eval().requires_grad_(False)
    return ensemble, curve


@torch.inference_mode()
def heldout_pairs(ensemble: QEnsemble, heldout: Heldout, gamma: float, unit: float = 1.0) -> Pairs:
    """Pair Q(h, z, a^E), mean over the members, with the discounted reward that really followed
    on episodes of the unimpaired expert. Q counts rewards in their `unit`.
    """
    q = unit * ensemble(heldout.latent.features, heldout.a_h).mean(0).double().numpy()
    return pairs(
        q, heldout.reward.double().numpy(), heldout.episode.numpy(), heldout.terminal.numpy(), gamma
    )
