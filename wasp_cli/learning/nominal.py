"""Episodes of the unimpaired latent expert without assistance, and their decisions as rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from wasp_cli.learning.closed_loop import Loop, run_episodes
from wasp_cli.methods.base import Heldout
from wasp_cli.methods.human import HumanOnly
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, Policy
from wasp_cli.tasks.base import VectorTask


def expert_episodes(
    task: VectorTask,
    model: SafetyWorldModel,
    skills: Skills,
    seeds: Sequence[int],
    *,
    keep_latents: bool = False,
    informed: Callable[[float], Policy] | None = None,
) -> Loop:
    """Run an episode per seed of the unimpaired operator without assistance.

    Args:
        task: as many episodes as seeds.
        model: filters.
        skills: latent policies, whose expert drives.
        seeds: of the worlds.
        keep_latents: also return the filtered latents.
        informed: privileged policies that drive instead, on a task whose operators know more than
            assistants perceive.
    """
    context = OperatorContext(skills.at, task.action_size, task.decision_seconds, informed)
    operator = Operator.build(1.0, context, EpisodeNoise(seeds), task.batch)
    return run_episodes(task, model, operator, HumanOnly(), seeds, seeds, keep_latents=keep_latents)


def heldout_rows(loop: Loop) -> Heldout:
    """Return the decisions of a loop with latents as rows, episode after episode, without those
    after the end of an episode.
    """
    assert loop.h is not None
    assert loop.z is not None
    alive = torch.from_numpy(loop.alive.T.copy())  # [B, T]
    episode = torch.arange(alive.shape[0]).unsqueeze(1).expand_as(alive)

    def rows(values: torch.Tensor) -> torch.Tensor:
        """From [T, B, ...] to the N rows."""
        return values.transpose(0, 1)[alive].clone()

    return Heldout(
        Latent(rows(loop.h), rows(loop.z)),
        rows(torch.from_numpy(loop.a_h)),
        rows(torch.from_numpy(loop.reward.astype(np.float32))),
        rows(torch.from_numpy(loop.cost.astype(np.float32))),
        episode[alive].clone(),
        rows(torch.from_numpy(loop.terminated.astype(np.float32))),
    )
