"""Fresh episodes under operators that are not in the dataset's mixture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wasp_cli.learning.dataset import Behaviour, Commander, record
from wasp_cli.learning.shards import Replay
from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask

HALF_TRAINED = 2
"""Index of the first checkpoint that is not among the two `early` ones of the mixture."""


def unseen_behaviours(skills: int) -> list[Behaviour]:
    """The kinds of operators; a half-trained one only where there is a checkpoint between the early ones and the last."""
    kinds = [
        Behaviour("sticky noise", sticky=1.0),
        Behaviour("delay with noise", delay=4, gaussian=0.25),
        Behaviour("drift", drift=0.5),
        Behaviour("half trained", skill=HALF_TRAINED),
        Behaviour("drift", drift=-0.5),
    ]
    return [kind for kind in kinds if kind.skill < 0 or kind.skill < skills - 1]


def unseen_episodes(task: VectorTask, skills: Sequence[PrivilegedPolicy], task_name: str, seed: int) -> Replay:
    """One episode per row of the task, with seeds that no other stage uses.

    Args:
        task: with pixels and privileged observations.
        skills: the checkpoints, the expert last.
        task_name: names the streams of seeds.
        seed: of the chain.
    """
    kinds = unseen_behaviours(len(skills))
    rows = [kinds[i % len(kinds)] for i in range(task.batch)]
    commander = Commander(skills, rows, task.action_size, np.random.default_rng(derive("diagnostics-commands", task_name, seed)))
    seeds = [derive("diagnostics-episode", task_name, seed, i) for i in range(task.batch)]
    return record(task, seeds, commander.command, [kind.name for kind in rows], 0)
