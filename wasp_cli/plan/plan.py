"""What a run would do: each node with a state and a reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Literal

from wasp_cli.errors import ArtifactError
from wasp_cli.plan.cell import Cell
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.keys import canonical
from wasp_cli.plan.node import Node
from wasp_cli.plan.part import Part
from wasp_cli.plan.waves import waves
from wasp_cli.store.artifact import damage, published, read_manifest, read_record
from wasp_cli.store.layout import Layout

State = Literal["cached", "missing", "damaged", "failed"]
_MEASURED = 300
"""Manifests read per kind for the estimate of times."""


@dataclass(frozen=True)
class Step:
    """A node and what becomes of it."""

    node: Node
    state: State
    reason: str

    @property
    def runs(self) -> bool:
        """Whether a run would compute it."""
        return self.state != "cached"


@dataclass(frozen=True)
class Plan:
    """Every node of a grid with its state."""

    grid: Grid
    steps: tuple[Step, ...]
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Median time of each sort of node, where the store has some."""

    def to_run(self) -> list[Node]:
        """The nodes that a run computes, needed ones first."""
        return [step.node for step in self.steps if step.runs]

    def count(self, state: State, kind: str | None = None) -> int:
        """Number of nodes in a state."""
        return sum(step.state == state and kind in (None, step.node.kind) for step in self.steps)

    def kinds(self) -> list[str]:
        """The kinds of nodes, in the order in which they first run."""
        return list(dict.fromkeys(node.kind for wave in waves(step.node for step in self.steps) for node in wave))

    def estimate(self, workers: int) -> tuple[float, int]:
        """Seconds for the nodes that are to run, and how many of them have no measured time."""
        total, unknown = 0.0, 0
        for wave in waves(self.to_run()):
            known = [self.seconds[sort_of(node)] for node in wave if sort_of(node) in self.seconds]
            unknown += len(wave) - len(known)
            total += max(sum(known) / workers, max(known, default=0.0))
        return total, unknown

    def as_json(self) -> dict[str, Any]:
        """As plain values: for machines, and for the report of a run that is long over."""
        return {
            "points": self.grid.points,
            "cells": [{**cell.as_json(), "key": node.key} for cell, node in self.grid.cells],
            "parts": [{**part.as_json(), "key": node.key} for part, node in self.grid.parts],
            "nodes": [_node_json(step) for step in self.steps],
            "counts": dict(Counter(step.state for step in self.steps)),
        }

    def of(self, grid: Grid) -> Plan:
        """The part of this plan that is about a grid whose nodes it has."""
        steps = {step.node.key: step for step in self.steps}
        return Plan(grid, tuple(steps[node.key] for node in grid.nodes), self.seconds)


def _node_json(step: Step) -> dict[str, Any]:
    node = step.node
    needs = {name: needed.key for name, needed in node.needs.items()}
    return {"key": node.key, "kind": node.kind, "label": node.label, "state": step.state, "reason": step.reason, "needs": needs}


def make_plan(
    grid: Grid,
    stored: Mapping[str, set[str]],
    failures: Mapping[str, str],
    seconds: Mapping[str, float] | None = None,
    damages: Mapping[str, str] | None = None,
) -> Plan:
    """Give each node its state.

    Args:
        grid: what the spec asks for.
        stored: keys in the store, by kind.
        failures: cause of the last failure, by key.
        seconds: measured times by `sort_of` node.
        damages: what is wrong with a stored artifact, by key.
    """
    return Plan(grid, tuple(_step(node, stored, failures, damages or {}) for node in grid.nodes), seconds or {})


def _step(node: Node, stored: Mapping[str, set[str]], failures: Mapping[str, str], damages: Mapping[str, str]) -> Step:
    if node.key in damages:
        return Step(node, "damaged", f"damaged, to be computed again: {damages[node.key]}")
    if node.key in stored.get(node.kind, ()):
        return Step(node, "cached", "computed before")
    if node.key in failures:
        return Step(node, "failed", f"failed before: {failures[node.key]}")
    return Step(node, "missing", "not computed yet")


def plan_against(grid: Grid, layout: Layout, *, estimate: bool = True) -> Plan:
    """The plan of a grid over the store of a results folder."""
    kinds = dict.fromkeys(node.kind for node in grid.nodes)
    stored = {kind: published(layout, kind) for kind in kinds}
    damages = {node.key: wrong for node in grid.nodes if node.key in stored[node.kind] and (wrong := damage(layout, node.kind, node.key))}
    failures: dict[str, str] = {}
    wanted = {node.key for node in grid.nodes}
    for path in layout.failures.glob("*.json"):
        if path.stem in wanted:
            failures[path.stem] = _cause(path)
    plan = make_plan(grid, stored, failures, damages=damages)
    if not estimate or not plan.to_run():
        return plan
    return Plan(grid, plan.steps, measured(layout, stored))


def _cause(path: Path) -> str:
    try:
        return str((read_record(path) or {}).get("message", "unknown cause"))
    except ArtifactError:
        return "its record is damaged"


def sort_of(node: Node) -> str:
    """Nodes of a sort take about as long: the same stage, method and round at the same sizes, whatever the seed and the operator."""
    return _sort(node.kind, node.task, node.config, node.axes)


def _sort(kind: str, task: str, config: Mapping[str, Any], axes: Mapping[str, Any]) -> str:
    return canonical([kind, task, config, axes.get("method"), axes.get("method_config"), axes.get("round")])


def measured(layout: Layout, stored: Mapping[str, Iterable[str]]) -> dict[str, float]:
    """Median seconds by sort of node, from the manifests in the store."""
    times: dict[str, list[float]] = {}
    for kind, keys in stored.items():
        for key in sorted(keys)[:_MEASURED]:
            try:
                manifest = read_manifest(layout, kind, key)
                sort = _sort(kind, manifest["task"], manifest["config"], manifest["axes"])
                times.setdefault(sort, []).append(float(manifest["provenance"]["seconds"]))
            except (ArtifactError, KeyError, TypeError, ValueError, AttributeError):  # damaged: no measurement
                continue
    return {sort: median(values) for sort, values in times.items()}


def cells_with_keys(grid: Grid) -> list[tuple[Cell, str]]:
    """Each cell with the key of its artifact, as reports take them."""
    return [(cell, node.key) for cell, node in grid.cells]


def parts_with_keys(grid: Grid) -> list[tuple[Part, str]]:
    """Each trained part with the key of its artifact, as reports take them."""
    return [(part, node.key) for part, node in grid.parts]
