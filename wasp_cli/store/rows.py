"""The tables of a cell in memory: from trajectories and measures to the columns of `schema`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wasp_cli.metrics.episode import EpisodeMetrics, Trajectory
from wasp_cli.store.schema import (
    IDENTITY,
    METRICS,
    PLANNED,
    SCHEMA,
    STEP,
    STEP_TIME,
    STEPS_SCHEMA,
    CellIdentity,
    Thresholds,
)


class Rows(NamedTuple):
    """The two tables of a cell."""

    episodes: pa.Table  # of SCHEMA
    steps: pa.Table  # of STEPS_SCHEMA


def cell_tables(
    identity: CellIdentity,
    trajectories: Sequence[Trajectory],
    metrics: Sequence[EpisodeMetrics],
    thresholds: Thresholds,
    decision_ms: Sequence[NDArray[np.floating]],
    episode_seeds: Sequence[int],
    first: int = 0,
) -> Rows:
    """Build the tables of a cell in memory, or of its episodes from `first` on; the other arguments
    are those of `tables.write_cell`. Raises ValueError where they are not of the same number of
    episodes.
    """
    episodes = len(trajectories)
    if not episodes == len(metrics) == len(decision_ms) == len(episode_seeds):
        raise ValueError(
            f"{episodes} trajectories, {len(metrics)} rows, {len(decision_ms)} timings, "
            f"{len(episode_seeds)} seeds"
        )
    # A row per episode.
    shared = asdict(identity) | asdict(thresholds)
    columns: dict[str, Any] = {name: [value] * episodes for name, value in shared.items()}
    columns["episode"] = list(range(first, first + episodes))
    columns["episode_seed"] = [int(seed) for seed in episode_seeds]
    for field in METRICS:
        attribute = "return_" if field.name == "return" else field.name
        columns[field.name] = [getattr(row, attribute) for row in metrics]
    columns["decision_p50_ms"] = [_percentile(times, 50) for times in decision_ms]
    columns["decision_p95_ms"] = [_percentile(times, 95) for times in decision_ms]
    arrays = [pa.array(columns[field.name], field.type) for field in SCHEMA]
    episode_table = pa.table(arrays, schema=SCHEMA)

    # A row per decision, which repeats the identity of its episode.
    episode = np.repeat(np.arange(episodes), [trajectory.steps for trajectory in trajectories])
    names = [episode_table[field.name].take(episode) for field in IDENTITY]
    all_times = np.concatenate([np.asarray(times, np.float32) for times in decision_ms])
    times = pa.array(all_times, STEP_TIME.type)
    step_table = pa.table([*names, *_steps(trajectories), times], schema=STEPS_SCHEMA)
    return Rows(episode_table, step_table)


def _percentile(times: NDArray[np.floating], share: int) -> float | None:
    """A percentile of times; None of none."""
    return float(np.percentile(times, share)) if len(times) else None


def _steps(trajectories: Sequence[Trajectory]) -> list[pa.Array]:
    """The columns of STEP over the steps of all episodes."""

    lengths = [trajectory.steps for trajectory in trajectories]
    t = np.concatenate([np.arange(n) for n in lengths])
    columns = [pa.array(t, pa.int32())]
    planned = _planned(trajectories)
    for field in list(STEP)[1:]:
        if field.name not in PLANNED:
            parts = [np.asarray(getattr(trajectory, field.name)) for trajectory in trajectories]
            columns.append(_array_of(np.concatenate(parts), field.type))
        elif planned is None:
            columns.append(pa.nulls(sum(lengths), field.type))
        else:
            columns.append(_array_of(planned[field.name], field.type))
    return columns


def _planned(trajectories: Sequence[Trajectory]) -> dict[str, NDArray[Any]] | None:
    """The fields of PLANNED over all steps, masked where nothing was planned or searched; None
    of a method that does not plan.
    """
    plans = [trajectory.plans for trajectory in trajectories if trajectory.plans is not None]
    if len(plans) != len(trajectories):
        return None
    columns: dict[str, NDArray[Any]] = {}
    for name, source in PLANNED.items():
        columns[name] = np.concatenate([np.asarray(getattr(plan, source)) for plan in plans])
    columns["plan"] = columns["plan"].reshape(len(columns["plan"]), -1)

    # Steps [T] without a plan, and those without a search.
    unplanned = np.isnan(columns["plan"]).any(1)
    unsearched = columns["safe"][:, -1] < 0
    masked: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        lacks = unsearched if name in ("safe", "case2") else unplanned
        by_step = lacks.reshape(len(lacks), *(1 for _ in values.shape[1:]))
        masked[name] = np.ma.masked_array(values, np.broadcast_to(by_step, values.shape))
    return masked


def _array_of(values: NDArray[Any], kind: pa.DataType) -> pa.Array:
    """A column of steps [T] or of lists [T, K]; masked rows and NaN outside of lists are null."""
    mask = np.ma.getmaskarray(values)
    data = np.ma.getdata(values)
    if pa.types.is_list(kind):
        ends = np.arange(0, data.size + 1, data.shape[1], dtype=np.int32)
        inner = pa.array(data.ravel()).cast(kind.value_type)
        return pa.ListArray.from_arrays(ends, inner, type=kind, mask=pa.array(mask[:, 0]))
    if pa.types.is_float32(kind):
        return pa.array(data.astype(np.float32), kind, mask=mask | np.isnan(data))
    return pa.array(data, mask=mask).cast(kind)
