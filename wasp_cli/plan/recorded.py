"""What a run was to do, from its folder alone: for those who watch it, and for those who clean up.

Read with care: the folder may be of another version, half written, or untrusted. What has no valid form is left out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wasp_cli.errors import ArtifactError, StoreError, UnknownName
from wasp_cli.plan.plan import IDLE
from wasp_cli.store.artifact import read_record
from wasp_cli.store.layout import Layout, is_key, is_name
from wasp_cli.store.plain import read_plain


@dataclass(frozen=True)
class PlannedNode:
    """A node as the plan of a run has it."""

    key: str
    kind: str
    label: str
    state: str
    """When the run was planned: one of `plan.plan.State`."""
    needs: tuple[str, ...] = ()
    """Keys of what it reads."""
    seconds: float | None = None
    """How long it may take, where that was known."""

    @property
    def runs(self) -> bool:
        """Whether the run was to compute it."""
        return self.state not in IDLE


@dataclass(frozen=True)
class PlannedRun:
    """A run and what it was to do."""

    run_id: str
    spec: str
    """Name of the spec; of a sweep with the setting that varies."""
    nodes: Mapping[str, PlannedNode] = field(default_factory=dict)
    """By key."""
    parts: tuple[str, ...] = ()
    """The runs of a sweep's values, whose cells it computes."""
    odd: int = 0
    """Entries of the plan that were left out."""


def run_ids(layout: Layout) -> list[str]:
    """Return the runs of a results folder, newest first: by the number that each wrote down, so that no wrong clock counts.

    Raises:
        StoreError: there is no results folder, or it cannot be read.
    """
    try:
        with os.scandir(layout.within(layout.runs)) as entries:
            names = [entry.name for entry in entries if is_name(entry.name) and entry.is_dir(follow_symlinks=False)]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise StoreError(f"no results in '{layout.root}': {reason}", "wasp run SPEC --results DIR writes there") from error
    return sorted(names, key=lambda name: (order_of(layout, name), name), reverse=True)


def order_of(layout: Layout, run_id: str) -> int:
    """Return which of all runs one is, from 1 on; 0 where it does not say so."""
    try:
        return int(read_plain(layout.order(run_id)))
    except (OSError, ValueError):
        return 0


def planned_run(layout: Layout, run_id: str) -> PlannedRun | None:
    """Return a run as it was planned; None of a folder whose plan does not read."""
    swept = _record(layout, run_id, "sweep.json")
    if swept is not None:
        values = swept.get("values")
        named = [value.get("run") for value in values if isinstance(value, dict)] if isinstance(values, list) else []
        parts = tuple(run for run in named if isinstance(run, str) and is_name(run))
        plans = [_record(layout, run, "plan.json") or {} for run in parts]
        return _planned(run_id, f"{swept.get('spec')} --vary {swept.get('setting')}", plans, parts)
    plan = _record(layout, run_id, "plan.json")
    return _planned(run_id, plan["spec"], [plan]) if plan is not None and isinstance(plan.get("spec"), str) else None


def planned_runs(layout: Layout) -> list[PlannedRun]:
    """Return all runs whose plan reads, newest first; those of a sweep's values are a part of the sweep.

    Raises:
        StoreError: there is no results folder, or it cannot be read.
    """
    runs = [run for run_id in run_ids(layout) if (run := planned_run(layout, run_id)) is not None]
    of_sweeps = {part for run in runs for part in run.parts}
    return [run for run in runs if run.run_id not in of_sweeps]


def last_plan(layout: Layout, spec: str) -> Mapping[str, PlannedNode]:
    """Return what the last run of a spec was to do; empty where none is recorded."""
    try:
        ids = run_ids(layout)
    except StoreError:
        return {}
    plans = (planned_run(layout, run_id) for run_id in ids)
    return next((plan.nodes for plan in plans if plan is not None and plan.spec == spec), {})


def named_run(runs: Sequence[PlannedRun], text: str) -> PlannedRun:
    """Return the run of a name, or the newest whose name ends so, or the newest of the spec of this name.

    Raises:
        UnknownName: there is none.
    """
    for run in runs:
        if run.run_id == text:
            return run
    for run in runs:
        if text and run.run_id.endswith(text):
            return run
    for run in runs:
        if run.spec == text:
            return run
    raise UnknownName("run", text, [run.run_id for run in runs])


def keys_of(layout: Layout, run: str | None) -> frozenset[str] | None:
    """Return the keys of a run's nodes, of which `named_run` says which one is meant; None where none is.

    Raises:
        StoreError: the folder cannot be read.
        UnknownName: there is no such run.
    """
    return None if run is None else frozenset(named_run(planned_runs(layout), run).nodes)


def upstream_first(nodes: Mapping[str, PlannedNode]) -> Iterator[PlannedNode]:
    """Yield the nodes with those that they need before them; of a circle, which no plan of ours has, some order."""
    seen: set[str] = set()
    for key in nodes:
        pending = [(key, False)]
        while pending:
            current, expanded = pending.pop()
            if expanded:
                yield nodes[current]
            elif current not in seen and current in nodes:
                seen.add(current)
                pending.append((current, True))
                pending.extend((needed, False) for needed in nodes[current].needs)


def _record(layout: Layout, run_id: str, name: str) -> dict[str, Any] | None:
    try:
        return read_record(layout.within(layout.run(run_id)) / name)
    except (ArtifactError, StoreError):
        return None


def _planned(run_id: str, spec: str, plans: Iterable[Mapping[str, Any]], parts: tuple[str, ...] = ()) -> PlannedRun:
    entries = [entry for plan in plans if isinstance(plan.get("nodes"), list) for entry in plan["nodes"]]
    nodes = [node for entry in entries if isinstance(entry, dict) and (node := _node(entry)) is not None]
    return PlannedRun(run_id, spec, {node.key: node for node in nodes}, parts, len(entries) - len(nodes))


def _node(entry: Mapping[str, Any]) -> PlannedNode | None:
    texts = [entry.get(name) for name in ("key", "kind", "label", "state")]
    if not all(isinstance(text, str) for text in texts):
        return None
    key, kind, label, state = map(str, texts)
    needs = entry.get("needs")
    keys: Iterable[Any] = needs.values() if isinstance(needs, dict) else ()
    if not is_key(key) or not is_name(kind):
        return None
    return PlannedNode(
        key, kind, label, state, tuple(key for key in keys if isinstance(key, str) and is_key(key)), number(entry, "seconds")
    )


def number(record: Mapping[str, Any], name: str) -> float | None:
    """Return a finite number of a record; None where it has none."""
    value = record.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None
