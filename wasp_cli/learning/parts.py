"""Parts of episodes: more layouts for the same number of images.

An episode is divided into parts of equally many decisions, and one of them is recorded. What comes before is driven without a camera. B =
episodes side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.learning.dataset import Parts
from wasp_cli.learning.shards import HELD_OUT, held_out_period
from wasp_cli.tasks.base import VectorTask


def whole_episodes(share: float, episodes: int, random: np.random.Generator) -> NDArray[np.bool_]:
    """Choose the episodes [N] that are recorded whole: the share of the held-out ones, and of the others."""
    chosen, number = np.zeros(episodes, bool), np.arange(episodes)
    period = held_out_period(HELD_OUT)
    held = number % period == period - 1
    for group in (number[held], number[~held]):
        chosen[random.permutation(group)[: round(share * len(group))]] = True
    return chosen


def mean_decisions(decisions: int | None, whole_share: float, limit: int) -> float:
    """Return how many decisions an episode adds to a recording in the mean, if none ends early; `limit` is a whole one's length."""
    if decisions is None or decisions >= limit:
        return float(limit)
    return whole_share * limit + (1 - whole_share) * limit / -(-limit // decisions)


def can_begin_later(task: VectorTask) -> bool:
    """Say whether a task can be put where an episode was before: somebody else's may have no snapshots."""
    task.reset([0] * task.batch)
    try:
        task.snapshot()
    except TaskError:
        return False
    return True


def lead(
    task: VectorTask,
    seeds: Sequence[int],
    command: Callable[[NDArray[np.float32]], NDArray[Any]],
    whole: NDArray[np.bool_],
    decisions: int,
    random: np.random.Generator,
) -> Parts:
    """Drive to where the recording begins: the start for rows that are `whole` [B], else the beginning of one of the episode's parts.

    Every part that the episode reaches is equally likely, the first one too.

    Args:
        task: B episodes with privileged observations; no camera is needed.
        seeds: of the episodes.
        command: who drives there: from privileged observations [B, P] to actions [B, A].
        whole: rows of which everything is recorded.
        decisions: of a part.
        random: of the choice.
    """
    parts = -(-task.max_decisions // decisions)
    wanted = np.where(whole, 0, random.integers(parts, size=task.batch))
    seen, ended = task.reset(seeds), np.zeros(task.batch, bool)
    passed: list[dict[str, NDArray[Any]]] = []
    for count in range(int(wanted.max()) * decisions + 1):
        if count:
            assert seen.privileged is not None
            step = task.step(command(seen.privileged))
            seen, ended = step.observation, step.ended
        if count % decisions == 0:
            passed.append(now := task.snapshot())
            # Rows that are where their part begins end here for the task, which would else drive them on to the last part.
            ended = now["ended"] | (wanted <= count // decisions)
            task.restore({**now, "ended": ended})
        if ended.all():
            break
    reached = sum((~snapshot["ended"]).astype(np.int64) for snapshot in passed)
    # An episode that is over before the part that was drawn: one of the parts that there are.
    part = np.where(wanted < reached, wanted, (random.random(task.batch) * reached).astype(np.int64))
    begin = {name: np.stack([passed[part[row]][name][row] for row in range(task.batch)]) for name in passed[0]}
    return Parts(begin, np.where(whole, task.max_decisions, decisions))
