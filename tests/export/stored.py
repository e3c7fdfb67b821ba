"""Datasets and cells of invented numbers in a store, as stages leave them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.plans import trajectory
from wasp_cli.learning.shards import PIXELS, Recording, write_shard
from wasp_cli.metrics.episode import Trajectory, episode_metrics
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.schema import CellIdentity, Thresholds
from wasp_cli.store.tables import write_cell


def key_of(kind: str, number: int) -> str:
    """A key that no other kind and number have."""
    return f"{'d' if kind == 'dataset' else 'e'}{number:03x}".ljust(20, "0")


def recording(
    lengths: Sequence[int], action: int, state: int | None, first: int = 0, seed: int = 0
) -> Recording:
    """Episodes of T decisions each, one after the other; images where `state` is None."""
    random = np.random.default_rng(seed)
    rows = sum(lengths) + len(lengths)
    starts = np.cumsum([0, *(length + 1 for length in lengths)])
    first_rows = np.zeros(rows, np.float32)
    first_rows[starts[:-1]] = 1
    numbers = np.repeat(np.arange(first, first + len(lengths)), [n + 1 for n in lengths])
    moved = first_rows[:, None] == 0
    cost_env = random.integers(0, 3, rows).astype(np.float32) * moved[:, 0]
    terminal = np.zeros(rows, np.float32)
    terminal[starts[1:] - 1] = np.arange(len(lengths)) % 2
    return Recording(
        pixels=random.integers(0, 256, (rows, *PIXELS)).astype(np.uint8)
        if state is None
        else np.zeros(0, np.uint8),
        action=(random.uniform(-1, 1, (rows, action)) * moved).astype(np.float32),
        reward=(random.normal(size=rows) * moved[:, 0]).astype(np.float32),
        cost=(cost_env > 0).astype(np.float32),
        cost_env=cost_env,
        sources=np.zeros((rows, 0), np.int16),
        goals=(random.integers(0, 2, rows) * moved[:, 0]).astype(np.int16),
        terminal=terminal,
        first=first_rows,
        privileged=random.normal(size=(rows, 3)).astype(np.float32),
        episode=numbers.astype(np.int32),
        behaviour=np.array([f"driver{n}" for n in numbers], dtype=object),
        state=np.zeros(0, np.float32)
        if state is None
        else random.normal(size=(rows, state)).astype(np.float32),
    )


def store_dataset(
    layout: Layout, shards: Sequence[Recording], task: str = "goal1", seed: int = 1, number: int = 0
) -> str:
    """Store a dataset; returns its key."""
    key = key_of("dataset", number)
    staging = staging_folder(layout, key)
    for place, shard in enumerate(shards):
        write_shard(staging / f"shard-{place:04d}.parquet", shard, [])
    commit(layout, "dataset", key, staging, _manifest("dataset", key, task, seed, {}, "dataset"))
    return key


def store_cell(
    layout: Layout,
    trajectories: Sequence[Trajectory],
    identity: CellIdentity,
    number: int = 0,
    **facts: Any,
) -> str:
    """Store a cell; returns its key."""
    key = key_of("evaluate", number)
    staging = staging_folder(layout, key)
    metrics = [episode_metrics(each, 1, 25.0, lambda action: action) for each in trajectories]
    times = [np.ones(each.steps) for each in trajectories]
    worlds = [100 + e for e in range(len(trajectories))]
    write_cell(staging, identity, trajectories, metrics, Thresholds(), times, worlds)
    axes = {
        "method": identity.method,
        "method_config": {} if identity.variant == "full" else {"variant": identity.variant},
        "operator": identity.operator,
        "value": identity.value,
    }
    method = identity.method
    if identity.variant != "full":
        method = f"{method}/{identity.variant}"
    severity = "" if identity.value is None else f"={identity.value:g}"
    what = f"{method} {identity.operator}{severity}"
    manifest = _manifest("evaluate", key, identity.task, identity.seed, axes, what)
    commit(layout, "evaluate", key, staging, {**manifest, **facts})
    return key


def corrected(steps: int, action: int = 2, seed: int = 0, **changes: Any) -> Trajectory:
    """T decisions in which an assistant corrects every second command."""
    random = np.random.default_rng(seed)
    command = random.uniform(-1, 1, (steps, action)).astype(np.float32)
    fired = np.arange(steps) % 2 == 1
    executed = np.where(fired[:, None], -command, command)
    cost_env = random.integers(0, 5, steps)
    return trajectory(
        steps,
        **{
            "reward": random.normal(size=steps).astype(np.float32),
            "cost": cost_env > 0,
            "cost_env": cost_env,
            "goals": random.integers(0, 2, steps),
            "a_h": command,
            "a": executed,
            "gate": np.where(fired, 1, 0).astype(np.int8),
            "g_cost": np.where(fired, random.uniform(size=steps), np.nan).astype(np.float32),
            "delta_g": np.where(fired, np.nan, random.uniform(size=steps)).astype(np.float32),
            **changes,
        },
    )


def cell(operator: str = "laggy", value: float | None = 0.7, **changes: Any) -> CellIdentity:
    """The name of a cell of WASP on Goal1."""
    named = {"task": "goal1", "method": "wasp", "variant": "full", "seed": 1, **changes}
    return CellIdentity(operator=operator, value=value, **named)


def store_of(folder: Path) -> Layout:
    """An empty store."""
    layout = Layout(folder / "results")
    layout.prepare()
    return layout


def _manifest(
    kind: str, key: str, task: str, seed: int, axes: dict[str, Any], what: str
) -> dict[str, Any]:
    return {
        "kind": kind,
        "key": key,
        "task": task,
        "seed": seed,
        "label": f"{task} s{seed} {what}",
        "axes": axes,
        "settings": {"action_repeat": 4},
        "summary": {},
        "provenance": {"started_at": "2026-11-01T12:00:00"},
    }
