"""What a run would do: each node with a state and a reason, for runs, which do exactly that,
and for people.
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
from typing import TYPE_CHECKING, Any, Literal, get_args

from wasp_cli.console import count_table, duration
from wasp_cli.errors import ArtifactError
from wasp_cli.operators.registry import PERSON, UNIMPAIRED
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

if TYPE_CHECKING:
    from rich.console import Console

State = Literal["cached", "published", "missing", "changed", "failed", "damaged", "unneeded"]
IDLE = ("cached", "published", "unneeded")


@dataclass(frozen=True, slots=True)
class Step:
    node: Node
    state: State
    reason: str

    @property
    def runs(self) -> bool:
        return self.state not in IDLE


@dataclass(frozen=True)
class Plan:
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
        return [step.node for step in self.steps if step.runs]

    def count(self, state: State, kind: str | None = None) -> int:
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
        """Return the seconds for the nodes that are to run, and how many of them have no
        measured time (they count as nothing).

        `cores` are shared by the nodes that run at once; None: as many as there are workers.
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
                }
                for step in self.steps
            ],
            "notes": list(self.grid.notes),
            "counts": dict(Counter(step.state for step in self.steps)),
            "critical_path": {"seconds": seconds, "nodes": [node.key for node in path]},
        }

    def of(self, grid: Grid) -> Plan:
        steps = {step.node.key: step for step in self.steps}
        return replace(self, grid=grid, steps=tuple(steps[node.key] for node in grid.nodes))


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
    """Give each node its state; `wanted` are keys of what to compute, with what it needs: all
    targets of the grid by default.
    """
    targets = grid.targets if wanted is None else wanted
    scope, required = set(targets), set(targets)
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
        # Never computed, whatever became of it in the store: under this code its key would not be
        # the truth.
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
    reasons = Reasons(layout, stored)
    made = partial(
        make_plan, grid, stored.whole, failures, measured(stored), changed=reasons.of, wanted=wanted
    )
    plan = made(damages)
    read = {
        (needed.kind, needed.key)
        for node in plan.to_run()
        for needed in node.needs.values()
        if needed.key not in grid.reused
    }
    if cut := {
        key: WITHOUT_STEPS
        for kind, key in read
        if (facts := stored.whole[kind].get(key)) is not None and facts.cut
    }:
        plan = made(damages | cut)
    # Cells that are to run, and of which another version is there.
    again = [
        step.node
        for step in plan.steps
        if step.node.kind == "evaluate" and step.state in ("changed", "failed", "damaged")
    ]
    begun = {node.key: key for node in again if (key := reasons.beginning(node)) is not None}
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


COLUMNS: dict[State, str] = {state: state for state in get_args(State)} | {
    "failed": "failed before",
    "unneeded": "not needed",
}
SHOWN = 12


def show(
    plan: Plan, console: Console, workers: int, *, cores: int | None = None, every: bool = False
) -> None:
    """Print the counts by kind, why what runs has to run, the size of the grid, and how long it
    takes on so many workers, which share `cores` (None: one for each).

    With `every` each node is listed, with its state and reason.
    """
    counts = plan.counts()
    total = sum(counts.values(), Counter())
    columns = [state for state in COLUMNS if state in ("cached", "missing") or total[state]]
    table = count_table("stage", "nodes", *(COLUMNS[state] for state in columns))
    for kind, states in counts.items():
        table.add_row(kind, str(states.total()), *(str(states[state] or "-") for state in columns))
    table.add_section()
    table.add_row(
        "total", str(total.total()), *(str(total[state]) for state in columns), style="bold"
    )
    console.print(table)
    cells, branched = (
        len({node.key for _, node in pairs}) for pairs in (plan.grid.cells, plan.grid.branched)
    )
    size = f"{plan.grid.points} grid points, {cells} cells to evaluate"
    if cells < plan.grid.points and any(cell.operator == UNIMPAIRED for cell, _ in plan.grid.cells):
        size += " (the unimpaired reference is one cell for all operators)"
    if branched:
        size += f"; the interventions of {branched} of them are judged by counterfactual branches"
    console.print(size if cells else "nothing to evaluate: the spec lists no methods")
    for line in (
        *plan.grid.notes,
        *(_every(plan) if every else _reasons(plan)),
        *_chosen(plan),
        *_time(plan, workers, cores or workers),
    ):
        console.print(line, markup=False, soft_wrap=True)


def _chosen(plan: Plan) -> list[str]:
    """A line for each operating point and each severity that is known."""
    labels = {step.node.key: step.node.label for step in plan.steps}
    return [f"{labels[key]}: {choice}" for key, choice in plan.chosen.items()]


def _reasons(plan: Plan) -> list[str]:
    lines = reason_lines(plan, "published", "changed", "failed", "damaged")
    if len(lines) > SHOWN:
        lines[SHOWN:] = [f"and {len(lines) - SHOWN} more reasons; --all lists every node"]
    if any(
        step.state == "published" and plan.grid.reused[step.node.key].details for step in plan.steps
    ):
        lines.append("wasp plan --all names what has changed since then")
    return lines


def reason_lines(plan: Plan, *states: State) -> list[str]:
    labels: dict[str, list[str]] = {}
    for step in plan.steps:
        if step.state in states:
            labels.setdefault(step.reason, []).append(step.node.label)
    return [
        f"{first}{f' and {len(more)} more' if more else ''}: {reason}"
        for reason, (first, *more) in labels.items()
    ]


def _every(plan: Plan) -> list[str]:
    labels = max((len(step.node.label) for step in plan.steps), default=0)
    lines = [
        f"{step.node.key[:8]}  {COLUMNS[step.state]:<13}  {step.node.label:<{labels}}  "
        f"{step.reason}"
        for step in plan.steps
    ]
    details = [
        reused.details if (reused := plan.grid.reused.get(step.node.key)) else ""
        for step in plan.steps
    ]
    return [f"{line}; {more}" if more else line for line, more in zip(lines, details, strict=True)]


def _time(plan: Plan, workers: int, cores: int) -> list[str]:
    if not plan.to_run():
        copied = plan.count("published")
        return [
            f"nothing to compute: a run copies {copied} published result{'s' if copied > 1 else ''}"
            if copied
            else "nothing to run"
        ]
    people = [node for node in plan.to_run() if node.axes.get("operator") == PERSON]
    lines: list[str] = []
    if people:
        lines = [
            f"{len(people)} cell{'s wait' if len(people) > 1 else ' waits'} for people, "
            "whom no run replaces: wasp drive SPEC"
        ]
        if len(people) == len(plan.to_run()):
            return lines
    seconds, unknown = plan.estimate(workers, cores)
    if not seconds:
        return [
            *lines,
            "no time estimate: neither here nor elsewhere was a node like these measured",
        ]
    rest = f", not counting {unknown} nodes of sizes that have not been measured" if unknown else ""
    longest, path = plan.critical_path(cores)
    names = [node.label for node in path]
    if len(names) > SHOWN:
        names[SHOWN // 2 : -SHOWN // 2] = ["..."]
    alike = sum(node.sort in plan.guessed for node in plan.to_run())
    if plan.begun:
        count = len(plan.begun)
        rest += (
            f"; whole batches of episodes of {count} cell{'s' if count > 1 else ''} are there "
            "and are taken over"
        )
    source = (
        f"; for {alike} nodes an estimate, from times of nodes like them or of another machine"
        if alike
        else ""
    )
    borrowed = sum(node.sort in plan.borrowed for node in plan.to_run())
    if borrowed:
        source += f"; for {borrowed} nodes an estimate, from other tasks and sizes"
    return [
        *lines,
        f"about {duration(seconds)} on {workers} worker{'s' if workers > 1 else ''}{rest}{source}",
        *_unmeasured(plan),
        f"critical path {duration(longest)}: {' > '.join(names)}",
    ]


def _unmeasured(plan: Plan) -> list[str]:
    """What the time does not count, by environment."""
    decisions: Counter[str] = Counter()
    for node in plan.to_run():
        decisions[node.task] += plan.unmeasured.get(node.sort, 0)
    return [
        f"not counting about {count:,} decisions in {task}: how long one takes there is known when "
        "the first node of a run has ended"
        for task, count in decisions.items()
        if count
    ]
