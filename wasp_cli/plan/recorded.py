"""What a run was to do, from its folder alone: for those who watch it, and for those who clean up.

The folder may be half written or untrusted: a run whose plan has another form than ours is left
out.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, FiniteFloat, StringConstraints, TypeAdapter

from wasp_cli.errors import ArtifactError, StoreError, UnknownName
from wasp_cli.plan.plan import IDLE
from wasp_cli.plan.unmeasured import Stepping
from wasp_cli.store.layout import Layout, is_name
from wasp_cli.store.plain import read_plain
from wasp_cli.store.records import read_record

Key = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8,64}$")]  # as `layout.is_key`


@dataclass(frozen=True)
class PlannedNode:
    key: Key
    kind: str
    label: str
    state: str
    needs: Annotated[tuple[Key, ...], BeforeValidator(lambda needs: tuple(needs.values()))]
    seconds: FiniteFloat | None = None
    task: str = ""
    # in an environment that nobody had measured when it was planned: not in `seconds`
    decisions: Annotated[int, Field(ge=0, lt=2**53)] = 0
    # the part of `seconds` that several processes share
    stepping: Stepping | None = None

    @property
    def runs(self) -> bool:
        return self.state not in IDLE


NODES = TypeAdapter(list[PlannedNode])


@dataclass(frozen=True)
class PlannedRun:
    run_id: str
    spec: str  # name of the spec; of a sweep with the setting that varies
    nodes: Mapping[str, PlannedNode]  # needed ones first, as the plan lists them
    parts: tuple[str, ...] = ()  # the runs of a sweep's values, whose cells it computes
    restricted: bool = False  # as `Loaded.restricted`


def run_ids(layout: Layout) -> list[str]:
    """Return the runs of a results folder, newest first: by the number that each wrote down, so
    that no wrong clock counts.
    """
    try:
        with os.scandir(layout.within(layout.runs)) as entries:
            names = [
                entry.name
                for entry in entries
                if is_name(entry.name) and entry.is_dir(follow_symlinks=False)
            ]
    except (FileNotFoundError, NotADirectoryError) as error:
        what = "it holds no runs" if os.path.exists(layout.root) else "no such folder"
        raise StoreError(
            f"no results in '{layout.root}': {what}", "wasp run SPEC --results DIR writes there"
        ) from error
    except OSError as error:
        raise StoreError(
            f"cannot read the results in '{layout.root}': {(error.strerror or str(error)).lower()}"
        ) from error
    return sorted(names, key=lambda name: (order_of(layout, name), name), reverse=True)


def order_of(layout: Layout, run_id: str) -> int:
    """Return which of all runs one is, from 1 on; 0 where it does not say so."""
    with suppress(OSError, ValueError):
        return int(read_plain(layout.order(run_id)))
    return 0


def planned_run(layout: Layout, run_id: str) -> PlannedRun | None:
    """Return a run as it was planned; None of a folder whose plan does not read."""
    try:
        sweep = _record(layout, run_id, "sweep.json")
        if sweep is not None:
            parts = tuple(value["run"] for value in sweep["values"] if is_name(value["run"]))
            plans = [
                plan for part in parts if (plan := _record(layout, part, "plan.json")) is not None
            ]
            spec = f"{sweep['spec']} --vary {sweep['setting']}"
        else:
            parts, plans = (), [_record(layout, run_id, "plan.json") or {}]
            spec = plans[0]["spec"]
        nodes = [node for plan in plans for node in NODES.validate_python(plan["nodes"])]
    except (ArtifactError, StoreError, KeyError, TypeError, ValueError, AttributeError):
        return None
    restricted = any(plan.get("restricted") is True for plan in plans)
    return (
        PlannedRun(run_id, spec, {node.key: node for node in nodes}, parts, restricted)
        if isinstance(spec, str)
        else None
    )


def planned_runs(layout: Layout, *, parts: bool = False) -> list[PlannedRun]:
    """Return all runs whose plan reads, newest first; those of a sweep's values are a part of
    the sweep, and come with `parts` alone.
    """
    runs = [run for run_id in run_ids(layout) if (run := planned_run(layout, run_id)) is not None]
    of_sweeps = () if parts else {part for run in runs for part in run.parts}
    return [run for run in runs if run.run_id not in of_sweeps]


def last_plan(layout: Layout, spec: str) -> Mapping[str, PlannedNode]:
    """Return what the last run of a spec was to do; empty where none is recorded."""
    with suppress(StoreError):
        for run_id in run_ids(layout):
            if (plan := planned_run(layout, run_id)) is not None and plan.spec == spec:
                return plan.nodes
    return {}


def named_run(runs: Sequence[PlannedRun], text: str) -> PlannedRun:
    """Return the run of a name, or the newest of the spec of this name, or the newest whose
    name ends so.
    """
    named = [run for run in runs if text in (run.run_id, run.spec)] or [
        run for run in runs if text and run.run_id.endswith(text)
    ]
    if not named:
        raise UnknownName("run", text, [run.run_id for run in runs])
    return named[0]


def keys_of(layout: Layout, run: str | None, text: str) -> frozenset[str] | None:
    """Return the keys that a label or the beginning of a key may mean; None: any.

    Those of the run that `named_run` finds. Without one, those that a label has from the newest run
    on that left something of it.
    """
    from wasp_cli.store.named import same_label

    if run is not None:
        return frozenset(named_run(planned_runs(layout, parts=True), run).nodes)
    keys: set[str] = set()
    with suppress(StoreError):  # a folder without runs
        for planned in planned_runs(layout):
            nodes = [
                node
                for node in planned.nodes.values()
                if same_label(node.label, " ".join(text.split()))
            ]
            keys.update(node.key for node in nodes)
            if any(layout.artifact(node.kind, node.key).is_dir() for node in nodes):
                return frozenset(keys)
    return None


def _record(layout: Layout, run_id: str, name: str) -> dict[str, Any] | None:
    return read_record(layout.within(layout.run(run_id)) / name)
