"""Episodes of an evaluated cell, or of a person's session, which is a cell too.

Their rows hold commands, actions, gates, rewards and costs, and nothing of what was seen. The
executed actions are therefore carried out in the task once more, without any model: what is seen
then is what was seen, since every reward and every end is compared with the recorded one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.export.episode import Episode, Origin
from wasp_cli.learning.playback import play
from wasp_cli.store.find import FoundNode
from wasp_cli.store.tables import cell_file, read_episodes, read_steps
from wasp_cli.tasks.declared import declare_from
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS
from wasp_cli.tasks.sight import seen_of

KIND = "evaluate"
SIDE_BY_SIDE = 10  # episodes that are played together, for speed
WITHOUT = "--no-observations exports the rows alone, without what was seen"

Told = Callable[[str], None]


class _Seen(NamedTuple):
    """What a task showed in one episode."""

    seen: NDArray[Any]  # [T + 1, ...]
    privileged: NDArray[Any]  # [T + 1, P]
    terminated: bool


def evaluated_episodes(
    node: FoundNode,
    *,
    observations: bool,
    limit: int | None = None,
    threads: int = 1,
    told: Told = lambda text: None,
) -> Iterator[Episode]:
    """Read the episodes of a cell that have steps.

    Args:
        node: of the kind `evaluate`.
        observations: whether the episodes are played again for what was seen. This runs the task:
            of somebody else's environment it imports the module that the cell names.
        limit: read the first episodes only; None: all.
        threads: of physics and cameras.
        told: called with a sentence where something is left out.

    Raises:
        UsageError: no episode has steps.
        ArtifactError: an episode that is played again differs from the recorded one.
        StoreError: the rows are damaged.
    """
    # -- whole episodes, in their order
    path = cell_file(node.path)
    rows = {int(row["episode"]): row for row in read_episodes([path]).to_pylist()}
    steps = read_steps(path)
    numbers = np.asarray(steps["episode"])
    here = [number for number in sorted(rows) if (numbers == number).any()]
    if not here:
        raise UsageError(
            f"'{node.label}' has no steps: it was published with the totals of its episodes alone",
            "wasp run SPEC --reuse none computes cells whole",
        )
    if len(here) < len(rows):
        told(
            f"{node.label}: {len(here)} of {len(rows)} episodes have steps; the others were "
            "published with their totals alone"
        )
    chosen = here[:limit]

    # -- a batch at a time, so that the images of one batch are in memory
    task = str(node.setting("task"))
    declare_from(task, node.setting("settings"))
    for begin in range(0, len(chosen), SIDE_BY_SIDE):
        batch = chosen[begin : begin + SIDE_BY_SIDE]
        columns = [_columns(steps.filter(pa.array(numbers == number))) for number in batch]
        shown: Sequence[_Seen | None] = [None] * len(batch)
        if observations:
            shown = _played(node, task, [rows[number] for number in batch], columns, threads)
        for number, values, seen in zip(batch, columns, shown, strict=True):
            yield _episode(node, rows[number], values, seen)


def origin_of(node: FoundNode, row: Mapping[str, Any]) -> Origin:
    """Return where an episode comes from; `row` is that of the episode."""
    return Origin(
        KIND,
        node.key or "",
        node.label or "",
        str(row["task"]),
        int(row["seed"]),
        str(row["operator"]),
        row["value"],
        str(row["method"]),
        str(row["variant"]),
    )


def _columns(steps: pa.Table) -> dict[str, NDArray[Any]]:
    """The columns of the steps of one episode that are exported, [T] or [T, A] each."""
    columns: dict[str, NDArray[Any]] = {}
    for name in ("a_h", "a"):
        flat = steps[name].combine_chunks().flatten()
        columns[name] = np.asarray(flat, np.float32).reshape(len(steps), -1)
    for name in ("reward", "g_cost", "delta_g", "signal"):
        columns[name] = np.asarray(steps[name], np.float32)  # null becomes NaN
    for name in ("cost_env", "env_steps", "goals"):
        columns[name] = np.asarray(steps[name], np.int64)
    columns["cost"] = np.asarray(steps["cost"], np.bool_)
    columns["gate"] = np.asarray(steps["gate"], np.int8)
    return columns


def _episode(
    node: FoundNode, row: Mapping[str, Any], steps: Mapping[str, NDArray[Any]], seen: _Seen | None
) -> Episode:
    return Episode(
        origin_of(node, row),
        int(row["episode"]),
        int(row["episode_seed"]),
        None if seen is None else seen.seen,
        None if seen is None else seen.privileged,
        command=steps["a_h"],
        action=steps["a"],
        reward=steps["reward"],
        cost=steps["cost"],
        cost_env=steps["cost_env"],
        goals=steps["goals"],
        gate=steps["gate"],
        predicted_cost=steps["g_cost"],
        predicted_gain=steps["delta_g"],
        signal=steps["signal"],
        terminated=_ended_early(row, steps) if seen is None else seen.terminated,
        success=bool(row["success"]),
    )


def _ended_early(row: Mapping[str, Any], steps: Mapping[str, NDArray[Any]]) -> bool:
    """Whether an episode ended before its time limit; rows do not hold why it ended."""
    return int(steps["env_steps"].sum()) < TASKS[str(row["task"])].env_steps


def _played(
    node: FoundNode,
    name: str,
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[Mapping[str, NDArray[Any]]],
    threads: int,
) -> list[_Seen]:
    """Carry the actions of a batch of B episodes out again."""
    sees = seen_of(name)
    task = make_task(
        name,
        len(rows),
        action_repeat=int(node.setting("settings", "action_repeat")),
        observe=(sees, "privileged"),
        threads=threads,
    )
    seen: list[NDArray[Any]] = []  # T + 1 times [B, ...]
    privileged: list[NDArray[Any]] = []
    terminated: list[NDArray[Any]] = []  # T times [B]
    try:
        for moment in play(
            task,
            [int(row["episode_seed"]) for row in rows],
            [values["a"] for values in columns],
            [values["reward"] for values in columns],
            number=int(rows[0]["episode"]),
        ):
            shown = getattr(moment.observation, sees)
            seen.append(shown.copy() if sees == "pixels" else shown.astype(np.float32))
            assert moment.observation.privileged is not None
            privileged.append(moment.observation.privileged.copy())
            if moment.last is not None:
                terminated.append(moment.last.terminated.copy())
    except ArtifactError as error:
        raise ArtifactError(f"{node.label}: {error.message}", f"{error.hint}; {WITHOUT}") from error

    # -- by episode
    lengths = [len(values["a"]) for values in columns]
    return [
        _Seen(
            np.stack([at[e] for at in seen[: length + 1]]),
            np.stack([at[e] for at in privileged[: length + 1]]),
            bool(terminated[length - 1][e]),
        )
        for e, length in enumerate(lengths)
    ]
