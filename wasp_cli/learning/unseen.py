"""Fresh episodes under operators that are in no dataset, on which a world model is judged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wasp_cli.learning.behaviours import Behaviour, Commander
from wasp_cli.learning.dataset import record
from wasp_cli.learning.shards import Recording
from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask

HALF_TRAINED = 2
"""Index of the first checkpoint that is not among the two `early` ones of the mixture."""


def unseen_behaviours(skills: int) -> list[Behaviour]:
    """List the behaviours of the operators. A half-trained one is among them only where there is a
    checkpoint between the early ones and the last.

    Args:
        skills: number of checkpoints.
    """
    kinds = [
        Behaviour("sticky noise", sticky=1.0),
        Behaviour("delay with noise", delay=4, gaussian=0.25),
        Behaviour("drift", drift=0.5),
        Behaviour("half trained", skill=HALF_TRAINED),
        Behaviour("drift", drift=-0.5),
    ]
    return [kind for kind in kinds if kind.skill < 0 or kind.skill < skills - 1]


def unseen_episodes(
    task: VectorTask, skills: Sequence[PrivilegedPolicy], task_name: str, seed: int
) -> Recording:
    """Record one episode per row of the task, with seeds that no other stage uses.

    Args:
        task: B episodes with what assistants see and privileged observations.
        skills: the checkpoints, the expert last.
        task_name: in the names of the random streams.
        seed: of the training chain.
    """
    kinds = unseen_behaviours(len(skills))
    rows = [kinds[i % len(kinds)] for i in range(task.batch)]
    random = np.random.default_rng(derive("diagnostics-commands", task_name, seed))
    commander = Commander(skills, rows, task.action_size, random)
    seeds = [derive("diagnostics-episode", task_name, seed, i) for i in range(task.batch)]
    return record(task, seeds, commander.command, [row.name for row in rows], 0)
