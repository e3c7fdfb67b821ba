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

RANDOM_BEHAVIOURS = ("noisy", "bursts", "random")
"""Behaviours of the dataset in which uniformly random commands are executed."""


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
    """Learn Q of acting once and following the expert afterwards: the target is r + gamma Q'(s',
    pi_E(s')).

    Every member has a target network of its own and sees the same transitions. A third of each
    batch comes from episodes in which uniformly random commands were executed ('noisy', 'bursts',
    'random'), so that actions like those of a human are covered.

    Args:
        skills: their expert acts after the first action.
        recording: action, reward, terminal, first, episode and behaviour of N rows; held-out rows
            are not learned.
        latents: of the N rows.
        config: sizes, updates and rates.
        gamma: discount per decision.
        seed: of all draws but the initial weights.
        report: called every 100 updates with the share that is done and a text.
        unit: of the rewards in Q, see `learning.reward_unit`.

    Returns:
        The frozen ensemble, and its TD loss at every hundredth update.
    """
    # -- networks
    ensemble = QEnsemble(config.members, latents.features, recording.action.shape[1], config.hidden)
    target = copy.deepcopy(ensemble).requires_grad_(False)
    optimizer = torch.optim.Adam(ensemble.parameters(), lr=config.learning_rate, fused=True)

    # -- transitions: row i + 1 holds what was executed at the state of row i, and what came of it
    source = generator(seed)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    is_random = np.isin(recording.behaviour[starts.numpy()], RANDOM_BEHAVIOURS)
    random_places = torch.from_numpy(np.flatnonzero(is_random))
    action = torch.from_numpy(recording.action)
    reward = torch.from_numpy(recording.reward) / unit
    terminal = torch.from_numpy(recording.terminal)
    curve: list[float] = []
    for update in range(config.updates):
        # -- sample transitions [B]
        places = torch.randint(len(starts), (config.batch,), generator=source)
        if len(random_places):
            third = config.batch // 3
            choice = torch.randint(len(random_places), (third,), generator=source)
            places[:third] = random_places[choice]
        index = starts[places]
        now = latents.at(index).features
        then = latents.at(index + 1).features

        # -- targets [K, B] of the K members
        with torch.no_grad():
            following = target(then, skills.expert(then)) * (1 - terminal[index + 1])
            returns = reward[index + 1] + gamma * following

        # -- update
        loss = torch.nn.functional.smooth_l1_loss(ensemble(now, action[index + 1]), returns)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

        # -- let the target network follow
        with torch.no_grad():
            for slow, online in zip(target.parameters(), ensemble.parameters(), strict=True):
                slow.lerp_(online, config.target_rate)

        # -- curve
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
    on held-out episodes of the unimpaired expert.

    Args:
        ensemble: trained.
        heldout: the episodes.
        gamma: discount per decision.
        unit: of the rewards in Q, see `learning.reward_unit`; the pairs are in the task's own unit.
    """
    values = ensemble(heldout.latent.features, heldout.a_h).mean(0)
    return pairs(
        unit * values.double().numpy(),
        heldout.reward.double().numpy(),
        heldout.episode.numpy(),
        heldout.terminal.numpy(),
        gamma,
    )
