"""The order in which nodes run, and how long they take. A node begins as soon as its inputs are
there; of several, nodes that show whether the rest is worth computing come first, then those with
the longest remaining path.

Times of nodes that this machine has not computed yet were measured on another one, and are scaled
by the speed of this one. The figures are medians by preset, stage, task and method, for stages in
`SIZES` per unit of their size; `python -m tests.benchmarks.times RESULTS` makes them. A variant
without a figure has that of its method, and a method without one that of WASP, the slowest.
"""

from __future__ import annotations

import heapq
import json
import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

from wasp_cli.plan.node import Node, with_upstream
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.reached import reached

FIRST = ("diagnostics",)  # kinds that judge what others build on, and are soon done


def durations(nodes: Iterable[Node], seconds: Mapping[str, float]) -> dict[str, float]:
    """Return how long each node will take, in seconds by key: as measured if its sort was, else by
    the weight of its stage.
    """
    nodes = list(nodes)
    per_weight = [
        seconds[node.sort] / weight
        for node in nodes
        if node.sort in seconds and (weight := STAGES[node.kind].weight)
    ]
    unit = median(per_weight) if per_weight else 1.0
    return {node.key: seconds.get(node.sort, unit * STAGES[node.kind].weight) for node in nodes}


class Schedule:
    """The nodes that are still to run, and which of them can begin. Inputs that are not among them
    are there already.
    """

    def __init__(self, nodes: Iterable[Node], lasting: Mapping[str, float]) -> None:
        """Take nodes, needed ones first, which is also the order of equals; `lasting` has their
        seconds by key (`durations`).
        """
        members = {node.key: node for node in nodes}
        self._members = members
        self._needs = {
            key: {needed.key for needed in node.needs.values()} & members.keys()
            for key, node in members.items()
        }
        self._dependents: dict[str, list[Node]] = {key: [] for key in members}
        for node in members.values():
            for needed in self._needs[node.key]:
                self._dependents[needed].append(node)
        path: dict[str, float] = {}
        for key in reversed(members):
            path[key] = lasting[key] + max(
                (path[node.key] for node in self._dependents[key]), default=0.0
            )
        self._rank = {
            key: (-math.inf if node.kind in FIRST else -path[key], place)
            for place, (key, node) in enumerate(members.items())
        }
        self._ready: list[tuple[tuple[float, int], Node]] = []
        self._left = set(members)
        for key, node in members.items():
            if not self._needs[key]:
                self.put(node)

    def __len__(self) -> int:
        return len(self._ready)

    def pop(self) -> Node:
        """Take the next node that can begin."""
        return heapq.heappop(self._ready)[1]

    def put(self, node: Node) -> None:
        """Give back a node that is to run again."""
        heapq.heappush(self._ready, (self._rank[node.key], node))

    def ended(self, node: Node) -> None:
        """Note that a node has ended; nodes that waited only for it can begin."""
        self._left.discard(node.key)
        for dependent in self._dependents[node.key]:
            needs = self._needs[dependent.key]
            needs.discard(node.key)
            if not needs and dependent.key in self._left:
                self.put(dependent)

    def failed(self, node: Node) -> list[Node]:
        """Give up a node, and return the nodes that can never begin without it, needed ones
        first.
        """
        self._left.discard(node.key)
        self._ready = [entry for entry in self._ready if entry[1].key != node.key]
        heapq.heapify(self._ready)
        behind = reached(self._dependents[node.key], lambda lost: self._dependents[lost.key])
        lost = [dependent for dependent in behind if dependent.key in self._left]
        self._left.difference_update(dependent.key for dependent in lost)
        return sorted(lost, key=lambda dependent: self._rank[dependent.key][1])

    def given_up(self, key: str, running: Collection[str]) -> list[Node]:
        """Give up the nodes that build on one that is there, except those that run now (`running`,
        keys). Returns what can never begin, needed ones first.
        """
        behind = {key}
        for node in with_upstream(self._members.values()):  # needed ones first
            if any(needed.key in behind for needed in node.needs.values()):
                behind.add(node.key)
        gone = (behind - {key} - set(running)) & self._left
        self._left -= gone
        self._ready = [entry for entry in self._ready if entry[1].key not in gone]
        heapq.heapify(self._ready)
        return [node for node in self._members.values() if node.key in gone]


def simulated(
    nodes: Iterable[Node],
    lasting: Mapping[str, float],
    workers: int | None,
    cores: int = 1,
    saved: Callable[[Node, int], float] = lambda node, threads: 0.0,
) -> tuple[float, int]:
    """Return how long the nodes take on so many workers (None: on any number), and how many run
    at once at most.

    The nodes that run share `cores` as those of a run do (`run.runner`); `saved` says how many of
    its seconds a node saves with so many threads.
    """
    schedule = Schedule(nodes, lasting)
    running: list[tuple[float, str, Node, int]] = []
    now = 0.0
    most = 0
    while True:
        while len(schedule) and (workers is None or len(running) < workers):
            in_use = sum(threads for _, _, _, threads in running)
            if workers is not None and in_use >= max(workers, cores):
                break
            together = min(workers or 1, len(running) + len(schedule))
            threads = max(1, min(cores // together, cores - in_use))
            node = schedule.pop()
            ends = now + lasting[node.key] - saved(node, threads)
            heapq.heappush(running, (ends, node.key, node, threads))
        most = max(most, len(running))
        if not running:
            return now, most
        now, _, node, _ = heapq.heappop(running)
        schedule.ended(node)


SLICES = 25
SLICE_SECONDS = 0.01
SIZE = 65_536
SIZES = {
    "expert": "interactions",
    "dataset": "steps",
    "world_model": "updates",
    "residual": "interactions",
    "evaluate": "episodes",
    "operating": "episodes",
    "severity": "episodes",
}
"""By stage the setting that its time grows with."""
DRIVEN_SEVERITIES = 4
"""How many severities a node of the stage `severity` drives, about: it stops where enough is known.
"""
SLOWEST = "wasp"


def figures_like(kind: str, task: str, axes: Mapping[str, Any]) -> list[str]:
    """Return the name of a figure (`evaluate goal1 wasp/no-case2`), then those that can replace it,
    nearest first.
    """
    if kind == "operating":  # its episodes take as long as those of an evaluation
        kind = "evaluate"
    if kind == "severity":  # and these as long as those without an assistant
        return [f"evaluate {task} human"]
    method = axes.get("method")
    config = axes.get("method_config")
    if not method:
        return [f"{kind} {task}"]
    variant = config.get("variant", "full") if isinstance(config, Mapping) else "full"
    own = [f"{method}/{variant}"] if variant != "full" else []
    return [f"{kind} {task} {assistant}" for assistant in dict.fromkeys((*own, method, SLOWEST))]


@cache
def speed() -> float:
    """Return how fast this machine computes, in rounds per second of a fixed mix of work, to scale
    times of another machine.
    """
    import numpy as np

    values = np.random.default_rng(0).random(SIZE, dtype=np.float32)

    def rounds_per_second() -> float:
        rounds = 0
        begun = time.thread_time()
        until = time.perf_counter() + SLICE_SECONDS
        while time.perf_counter() < until or not rounds:
            np.tanh(values * np.float32(1.5)) + np.float32(0.1)
            sum(number * number for number in range(2000))
            rounds += 1
        return rounds / max(time.thread_time() - begun, 1e-9)

    # the fastest: others may use the machine too
    return max(rounds_per_second() for _ in range(SLICES))


def shipped() -> Mapping[str, Any]:
    """Return the shipped figures: `speed` of the machine that measured them, and `seconds` by
    preset and name of a figure.
    """
    figures: Mapping[str, Any] = json.loads(
        (Path(__file__).parent / "times.json").read_text(encoding="utf-8")
    )
    return figures


def estimated(
    nodes: Iterable[Node], presets: Mapping[str, str], near: Iterable[tuple[Node, float]] = ()
) -> dict[str, float]:
    """Return the seconds by sort that nodes will take here, if there is a figure for them or for
    something similar.

    `near` are nodes of the same spec that were computed, each with its seconds.
    """
    figures = shipped()
    times: dict[tuple[str, str], list[float]] = {}  # of one unit, by preset and name of a figure
    for node, seconds in near:
        figure = presets[node.key], figures_like(node.kind, node.task, node.axes)[0]
        times.setdefault(figure, []).append(seconds / units(node.kind, node.config))
    here: dict[str, float] = {}
    elsewhere: dict[str, float] = {}
    for node in nodes:
        size = units(node.kind, node.config)
        preset = presets[node.key]
        for name in figures_like(node.kind, node.task, node.axes):
            if (preset, name) in times:
                here[node.sort] = median(times[preset, name]) * size
            elif name in figures["seconds"].get(preset, {}):
                elsewhere[node.sort] = figures["seconds"][preset][name] * size
            else:
                continue
            break
    scale = figures["speed"] / speed() if elsewhere else 1.0
    return here | {sort: seconds * scale for sort, seconds in elsewhere.items()}


def units(kind: str, config: Mapping[str, Any]) -> int:
    """Return how many times a figure a node of this size takes."""
    size = int(config.get(SIZES.get(kind, ""), 1))
    return DRIVEN_SEVERITIES * size if kind == "severity" else size
