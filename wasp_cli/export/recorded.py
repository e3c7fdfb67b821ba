"""Episodes of the dataset of a training, in which nobody corrects a command."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wasp_cli.export.episode import Episode, Origin
from wasp_cli.learning.shards import Recording, count_rows, read_shards, shard_files
from wasp_cli.seeds import derive
from wasp_cli.store.find import FoundNode

KIND = "dataset"
WORLDS = "dataset-episode"
"""The role of the seeds of its worlds (`stages.dataset`)."""


def recorded_episodes(
    node: FoundNode, *, observations: bool, limit: int | None = None
) -> Iterator[Episode]:
    """Read the episodes of a dataset, a shard at a time.

    Args:
        node: of the kind `dataset`.
        observations: whether what was seen is read.
        limit: read the first episodes only; None: all.

    Raises:
        ArtifactError: its shards are missing or damaged.
    """
    columns = (
        None
        if observations
        else [name for name in Recording._fields if name not in ("pixels", "state", "privileged")]
    )
    counts = [count_rows(path) for path in shard_files(node.path)]
    ends = np.cumsum(counts)
    rows = np.arange(int(ends[-1]))
    made = 0
    for count, end in zip(counts, ends, strict=True):
        shard = read_shards(node.path, columns, (rows >= end - count) & (rows < end))
        for episode in _of_shard(node, shard, observations=observations):
            if limit is not None and made == limit:
                return
            yield episode
            made += 1


def origin_of(node: FoundNode) -> Origin:
    """Return where the episodes of a dataset come from; `driver` is that of no episode yet."""
    return Origin(
        KIND,
        node.key or "",
        node.label or "",
        str(node.setting("task")),
        int(node.setting("seed")),
        "",
    )


def _of_shard(node: FoundNode, shard: Recording, *, observations: bool) -> Iterator[Episode]:
    """The episodes of a shard. Its rows are by arrival: row t holds what decision t - 1 led to."""
    origin = origin_of(node)
    starts = np.flatnonzero(shard.first)
    ends = [*starts[1:], len(shard.first)]
    for start, end in zip(starts, ends, strict=True):
        whole = slice(int(start), int(end))
        arrived = slice(int(start) + 1, int(end))
        decisions = int(end) - int(start) - 1
        number = int(shard.episode[start])
        undefined = np.full(decisions, np.nan, np.float32)
        action = shard.action[arrived]
        yield Episode(
            replace(origin, driver=str(shard.behaviour[start])),
            number,
            derive(WORLDS, origin.task, origin.seed, number),
            shard.seen[whole] if observations else None,
            shard.privileged[whole] if observations else None,
            command=action,
            action=action,
            reward=shard.reward[arrived],
            cost=shard.cost[arrived] > 0,
            cost_env=shard.cost_env[arrived].astype(np.int64),
            goals=shard.goals[arrived].astype(np.int64),
            gate=np.zeros(decisions, np.int8),
            predicted_cost=undefined,
            predicted_gain=undefined,
            signal=undefined,
            terminated=bool(shard.terminal[arrived].any()),
        )
