"""Recording of episodes as a shard of a dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.learning.shards import Recording
from wasp_cli.tasks.base import Observation, VectorTask


def record(
    task: VectorTask,
    seeds: Sequence[int],
    command: Callable[[NDArray[np.float32]], NDArray[Any]],
    names: Sequence[str],
    number: int,
) -> Recording:
    """Record one episode per row of a task, rows by arrival (see `learning.shards`).

    Args:
        task: B episodes with privileged observations and what assistants see: pixels, or the
            state where the task shows no image.
        seeds: [B] of the worlds.
        command: from privileged observations [B, P] to actions [B, A].
        names: [B] behaviour of each row.
        number: index of the first episode in the dataset.
    """
    # -- the first rows: nothing has led there
    observation = task.reset(seeds)
    batch = task.batch
    kinds = task.cost_sources
    assert observation.privileged is not None
    zeros = np.zeros(batch, np.float32)
    rows: list[dict[str, NDArray[Any]]] = [
        {
            **_seen(observation),
            "action": np.zeros((batch, task.action_size), np.float32),
            "reward": zeros,
            "cost": zeros,
            "cost_env": zeros,
            "sources": np.zeros((batch, len(kinds)), np.int16),
            "goals": np.zeros(batch, np.int16),
            "terminal": zeros,
            "first": zeros + 1,
            "privileged": observation.privileged,
        }
    ]

    # -- drive, until all episodes have ended
    alive = [np.ones(batch, bool)]
    ended = np.zeros(batch, bool)
    for _ in range(task.max_decisions):
        assert observation.privileged is not None
        action = command(observation.privileged)
        step = task.step(action)
        observation = step.observation
        assert observation.privileged is not None
        sources = np.zeros((batch, 0), np.int16)
        if kinds:
            sources = np.stack([step.sources[kind].astype(np.int16) for kind in kinds], 1)
        rows.append(
            {
                **_seen(observation),
                "action": action,
                "reward": step.reward.astype(np.float32),
                "cost": step.cost.astype(np.float32),
                "cost_env": step.cost_env.astype(np.float32),
                "sources": sources,
                "goals": step.goals.astype(np.int16),
                "terminal": (step.terminated & ~ended).astype(np.float32),
                "first": zeros,
                "privileged": observation.privileged,
            }
        )
        alive.append(~ended)
        ended = ended | step.ended
        if ended.all():
            break

    # -- episode after episode, without rows after an end. Each field is taken out of `rows` on the
    # way, so that the images of a shard are in memory at most twice.
    mask = np.stack(alive, 1)  # [B, T + 1]
    lengths = mask.sum(1)
    fields = {name: np.stack([row.pop(name) for row in rows], 1)[mask] for name in list(rows[0])}
    fields.setdefault("pixels", np.zeros(0, np.uint8))
    return Recording(
        episode=np.repeat(np.arange(number, number + batch, dtype=np.int32), lengths),
        behaviour=np.repeat(np.array(list(names), dtype=object), lengths),
        **fields,
    )


def _seen(observation: Observation) -> dict[str, NDArray[Any]]:
    """Return the column of what assistants see, by its name."""
    if observation.pixels is not None:
        return {"pixels": observation.pixels}
    assert observation.state is not None
    return {"state": observation.state.astype(np.float32)}
