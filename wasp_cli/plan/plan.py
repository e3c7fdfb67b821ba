"""What a run would do: each node with a state and a reason. `wasp plan` prints it, and runs carry
it out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from wasp_cli.errors import ArtifactError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import OPERATING, Grid
from wasp_cli.plan.node import Node
from wasp_cli.plan.reasons import Reasons, look_at, measured
from wasp_cli.plan.schedule import estimated, simulated
from wasp_cli.plan.unmeasured import Stepping, guessed
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import printable
from wasp_cli.store.records import read_record
from wasp_cli.store.severities import SEVERITY
from wasp_cli.store.slim import WITHOUT_STEPS

State = Literal["cached", "published", "missing", "changed", "failed", "damaged", "unneeded"]
IDLE = ("cached", "published", "unneeded")


@dataclass(frozen=True, slots=True)
class Step:
    """What a run would do about a node, and why."""

    node: Node
    state: State
    reason: str

    @property
    def runs(self) -> bool:
        """Whether a run would compute it."""
        return self.state not in IDLE


@dataclass(frozen=True)
class Plan:
    """What a run of a grid would do."""

    grid: Grid
    steps: tuple[Step, ...]
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Median time of each sort of node, where the store has some, else an estimate."""
    # keys of the targets that were selected; None when all are wanted
    wanted: frozenset[str] | None = None
    begun: Mapping[str, str] = field(default_factory=dict)
    """Keys of cells of which the store has the first episodes, each with the key of the cell
    that has them.
    """
    guessed: frozenset[str] = frozenset()
    """The sorts whose time is an estimate: nodes like them were measured, or other machines
    measured them.
    """

    borrowed: frozenset[str] = frozenset()
    """The sorts whose time is an estimate from other tasks or presets: nothing alike was measured.
    """
    chosen: Mapping[str, str] = field(default_factory=dict)
    """By key of a node that has chosen an operating point or a severity before, what it chose, in
    words.
    """
    unmeasured: Mapping[str, int] = field(default_factory=dict)
    """By sort the decisions in an environment that nobody has measured: their time is in no
    estimate.
    """

    stepping: Mapping[str, Stepping] = field(default_factory=dict)
    """By sort the part of `seconds` that several processes share, where a node has threads."""

    def to_run(self) -> list[Node]:
        """Return the nodes that a run would compute, needed ones first."""
        return [step.node for step in self.steps if step.runs]

    def count(self, state: State, kind: str | None = None) -> int:
        """Return how many nodes are in a state, of one kind or of all."""
        return sum(step.state == state and kind in (None, step.node.kind) for step in self.steps)

    def counts(self) -> dict[str, Counter[State]]:
        """Return the number of nodes by kind and state; kinds in the order in which they first
        run.
        """
        counts: dict[str, Counter[State]] = {}
        levels: dict[str, int] = {}
        for step in self.steps:  # needed ones first
            counts.setdefault(step.node.kind, Counter())[step.state] += 1
            levels[step.node.key] = max(
                (
                    1 + levels[needed.key]
                    for needed in step.node.needs.values()
                    if needed.key in levels
                ),
                default=0,
            )
        order = dict.fromkeys(
            step.node.kind for step in sorted(self.steps, key=lambda step: levels[step.node.key])
        )
        return {kind: counts[kind] for kind in order}

    def estimate(self, workers: int, cores: int | None = None) -> tuple[float, int]:
        """Return the seconds for the nodes that are to run, and how many of them have no measured
        time (they count as 0). Nodes that run at once share `cores`; None: as many as there are
        workers.
        """
        nodes = [node for node in self.to_run() if node.axes.get("operator") != PERSON]
        lasting = {node.key: self.seconds.get(node.sort, 0.0) for node in nodes}
        total, _ = simulated(nodes, lasting, workers, cores or workers, self._saved)
        return total, sum(node.sort not in self.seconds for node in nodes)

    def _saved(self, node: Node, threads: int) -> float:
        """Seconds that a node saves with so many threads."""
        stepping = self.stepping.get(node.sort)
        return 0.0 if stepping is None else stepping.saved(threads)

    def critical_path(self, threads: int = 1) -> tuple[float, list[Node]]:
        """Return the seconds of the longest chain of nodes, and the chain, where each node has so
        many threads.
        """
        # by key the longest one that ends with this node
        paths: dict[str, tuple[float, list[Node]]] = {}
        none: tuple[float, list[Node]] = (0.0, [])
        for node in self.to_run():  # needed ones first
            needed = [paths[each.key] for each in node.needs.values() if each.key in paths]
            seconds, before = max(needed, key=itemgetter(0), default=none)
            lasts = self.seconds.get(node.sort, 0.0) - self._saved(node, threads)
            paths[node.key] = seconds + lasts, [*before, node]
        return max(paths.values(), key=itemgetter(0), default=none)

    def as_json(self) -> dict[str, Any]:
        """Return the plan as `wasp plan --json` prints it, and as a run records it."""
        seconds, path = self.critical_path()
        return {
            "points": self.grid.points,
            "cells": [{**asdict(cell), "key": node.key} for cell, node in self.grid.cells],
            "branched": [{**asdict(cell), "key": node.key} for cell, node in self.grid.branched],
            "parts": [{**asdict(part), "key": node.key} for part, node in self.grid.parts],
            "nodes": [
                {
                    "key": step.node.key,
                    "kind": step.node.kind,
                    "label": step.node.label,
                    "state": step.state,
                    "reason": step.reason,
                    "needs": {name: needed.key for name, needed in step.node.needs.items()},
                    "seconds": self.seconds.get(step.node.sort),
                    "task": step.node.task,
                    "decisions": self.unmeasured.get(step.node.sort, 0),
                    "stepping": _as_record(self.stepping.get(step.node.sort)),
                }
                for step in self.steps
            ],
            "notes": list(self.grid.notes),
            "counts": dict(Counter(step.state for step in self.steps)),
            "critical_path": {"seconds": seconds, "nodes": [node.key for node in path]},
        }

    def of(self, grid: Grid) -> Plan:
        """Return the part of this plan that is about one of the grids that it was made for."""
        steps = {step.node.key: step for step in self.steps}
        return replace(self, grid=grid, steps=tuple(steps[node.key] for node in grid.nodes))


def _as_record(stepping: Stepping | None) -> dict[str, Any] | None:
    return None if stepping is None else asdict(stepping)


def make_plan(
    grid: Grid,
    stored: Mapping[str, Container[str]],
    failures: Mapping[str, str],
    seconds: Mapping[str, float] = MappingProxyType({}),
    damages: Mapping[str, str] = MappingProxyType({}),
    *,
    changed: Callable[[Node], str | None] = lambda node: None,
    wanted: frozenset[str] | None = None,
) -> Plan:
    """Give each node its state. `wanted` are the keys of what to compute, with what it needs; None:
    all targets of the grid.
    """
    targets = grid.targets if wanted is None else wanted
    scope = set(targets)
    required = set(targets)
    steps: list[Step] = []
    for node in reversed(grid.nodes):
        step = _step(node, grid, stored, failures, damages)
        if node.key in scope:
            scope.update(needed.key for needed in node.needs.values())
        # What is damaged is repaired also where only a finished node has read it: reports show it.
        if (
            step.state != "cached"
            and node.key not in required
            and not (node.key in damages and node.key in scope)
        ):
            step = Step(
                node,
                "unneeded",
                "everything that needs it is computed" if node.key in scope else "not selected",
            )
        elif step.runs:
            required.update(needed.key for needed in node.needs.values())
            if step.state == "missing" and (reason := changed(node)) is not None:
                step = Step(node, "changed", reason)
        steps.append(step)
    return Plan(grid, tuple(reversed(steps)), seconds, wanted)


def _step(
    node: Node,
    grid: Grid,
    stored: Mapping[str, Container[str]],
    failures: Mapping[str, str],
    damages: Mapping[str, str],
) -> Step:
    if node.key in grid.reused:
        # It is never computed here: its key stands for the code that has computed it.
        whole = node.key in stored.get(node.kind, ()) and node.key not in damages
        return Step(node, "cached" if whole else "published", grid.reused[node.key].reason)
    if node.key in damages:
        return Step(node, "damaged", f"damaged, to be computed again: {damages[node.key]}")
    if node.key in stored.get(node.kind, ()):
        return Step(node, "cached", "computed before")
    if node.key in failures:
        return Step(node, "failed", f"failed before: {failures[node.key]}")
    return Step(node, "missing", "not computed yet")


def plan_against(
    grid: Grid, layout: Layout, *, wanted: frozenset[str] | None = None, failed_only: bool = False
) -> Plan:
    """Return the plan of a grid over a results folder.

    Args:
        wanted: keys of what to compute, with what it needs; None: all targets of the grid.
        failed_only: only nodes that failed before, and those that wait for them.
    """
    # What is stored, what has failed and what is damaged, of these nodes.
    stored = look_at(layout, dict.fromkeys(node.kind for node in grid.nodes))
    nodes = {node.key for node in grid.nodes}
    failures = {
        path.stem: _cause(path) for path in layout.failures.glob("*.json") if path.stem in nodes
    }
    damages = {key: wrong for key, wrong in stored.damaged.items() if key in nodes}
    if failed_only:
        touched: set[str] = set()  # what failed, and what needs it
        for node in grid.nodes:
            if node.key in failures or any(needed.key in touched for needed in node.needs.values()):
                touched.add(node.key)
        wanted = frozenset(touched & (grid.targets if wanted is None else wanted))

    # The plan; made again if a node reads an artifact whose steps were left out, which then counts
    # as damaged.
    reasons = Reasons(layout, stored)
    planned = partial(
        make_plan, grid, stored.whole, failures, measured(stored), changed=reasons.of, wanted=wanted
    )
    plan = planned(damages)
    read = {
        (needed.kind, needed.key)
        for node in plan.to_run()
        for needed in node.needs.values()
        if needed.key not in grid.reused
    }
    without_steps = {}
    for kind, key in read:
        facts = stored.whole[kind].get(key)
        if facts is not None and facts.cut:
            without_steps[key] = WITHOUT_STEPS
    if without_steps:
        plan = planned(damages | without_steps)

    # Cells that are to run, and whose first episodes another version has.
    begun = {}
    for step in plan.steps:
        if step.node.kind == "evaluate" and step.state in ("changed", "failed", "damaged"):
            earlier = reasons.beginning(step.node)
            if earlier is not None:
                begun[step.node.key] = earlier

    # How long nodes take that were not measured here.
    new = [node for node in plan.to_run() if node.sort not in plan.seconds]
    timed = list(_timed(plan))
    alike = estimated(new, grid.presets, timed)
    others = guessed([node for node in new if node.sort not in alike], grid.presets, timed)
    return replace(
        plan,
        seconds={**plan.seconds, **alike, **others.seconds},
        begun=begun,
        guessed=frozenset(alike),
        borrowed=frozenset(others.seconds),
        unmeasured=others.decisions,
        stepping=others.stepping,
        chosen=dict(_choices(plan, layout)),
    )


def _choices(plan: Plan, layout: Layout) -> Iterator[tuple[str, str]]:
    """What earlier runs have chosen, by key of the node that did."""
    for step in plan.steps:
        kind = step.node.kind
        if kind not in (OPERATING, SEVERITY) or step.runs:
            continue
        with suppress(ArtifactError, LookupError, TypeError, ValueError):
            summary = read_manifest(layout, kind, step.node.key)["summary"]
            if kind == OPERATING:
                yield step.node.key, printable(str(summary["operating_point"]))
            else:  # that of the expert and of random commands chooses nothing
                yield step.node.key, f"{float(summary[SEVERITY]):g}"


def _timed(plan: Plan) -> Iterator[tuple[Node, float]]:
    for node in plan.grid.nodes:
        if node.sort in plan.seconds:
            yield node, plan.seconds[node.sort]
        elif node.key in plan.grid.reused:
            seconds = plan.grid.reused[node.key].offer.manifest["provenance"].get("seconds")
            if isinstance(seconds, int | float) and seconds > 0:
                yield node, float(seconds)


def _cause(path: Path) -> str:
    try:
        return str((read_record(path) or {}).get("message", "unknown cause"))
    except ArtifactError:
        return "its record is damaged"
