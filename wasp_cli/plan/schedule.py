"""The order in which nodes run: each as soon as what it needs is there, the longest remaining path first."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from statistics import median

from wasp_cli.plan.node import Node
from wasp_cli.stages.registry import STAGES


def durations(nodes: Iterable[Node], seconds: Mapping[str, float]) -> dict[str, float]:
    """Return how long each node will take, by key: as measured where its sort was, else by the weight of its stage."""
    nodes = list(nodes)
    per_weight = [seconds[node.sort] / weight for node in nodes if node.sort in seconds and (weight := STAGES[node.kind].weight)]
    unit = median(per_weight) if per_weight else 1.0
    return {node.key: seconds.get(node.sort, unit * STAGES[node.kind].weight) for node in nodes}


class Schedule:
    """The nodes that are still to run, and which of them can begin. Only needs among them count: the rest is computed."""

    def __init__(self, nodes: Iterable[Node], lasting: Mapping[str, float]) -> None:
        """`nodes` come needed ones first, which counts among equals; `lasting` has their seconds by key (`durations`)."""
        members = {node.key: node for node in nodes}
        self._needs = {key: {needed.key for needed in node.needs.values()} & members.keys() for key, node in members.items()}
        self._dependents: dict[str, list[Node]] = {key: [] for key in members}
        for node in members.values():
            for needed in self._needs[node.key]:
                self._dependents[needed].append(node)
        path: dict[str, float] = {}
        for key in reversed(members):
            path[key] = lasting[key] + max((path[node.key] for node in self._dependents[key]), default=0.0)
        self._rank = {key: (-path[key], place) for place, key in enumerate(members)}
        self._ready: list[tuple[tuple[float, int], Node]] = []
        self._left = set(members)
        for key, node in members.items():
            if not self._needs[key]:
                self.put(node)

    def __len__(self) -> int:
        """Return the number of nodes that can begin."""
        return len(self._ready)

    @property
    def left(self) -> int:
        """Nodes that have not ended."""
        return len(self._left)

    def pop(self) -> Node:
        """Take the ready node from which the longest path begins."""
        return heapq.heappop(self._ready)[1]

    def put(self, node: Node) -> None:
        """Make a node ready, also one that was taken before and has to run again."""
        heapq.heappush(self._ready, (self._rank[node.key], node))

    def waits(self, node: Node) -> bool:
        """Return whether a node has not ended, and nothing that it needs has failed."""
        return node.key in self._left

    def ended(self, node: Node) -> None:
        """Make ready what has waited for this node alone."""
        self._left.discard(node.key)
        for dependent in self._dependents[node.key]:
            needs = self._needs[dependent.key]
            needs.discard(node.key)
            if not needs and dependent.key in self._left:
                self.put(dependent)

    def failed(self, node: Node) -> list[Node]:
        """Give up a node, ready or taken, and return what can never begin without it, needed ones first."""
        self._left.discard(node.key)
        self._ready = [entry for entry in self._ready if entry[1].key != node.key]
        heapq.heapify(self._ready)
        lost: dict[str, Node] = {}
        waiting = [node]
        while waiting:
            for dependent in self._dependents[waiting.pop().key]:
                if dependent.key in self._left:
                    self._left.discard(dependent.key)
                    lost[dependent.key] = dependent
                    waiting.append(dependent)
        return sorted(lost.values(), key=lambda each: self._rank[each.key][1])


def simulated(nodes: Iterable[Node], lasting: Mapping[str, float], workers: int | None) -> tuple[float, int]:
    """Return how long the nodes take on so many workers (None: on any number), and how many run at once at most."""
    schedule = Schedule(nodes, lasting)
    running: list[tuple[float, str, Node]] = []
    now, most = 0.0, 0
    while True:
        while len(schedule) and (workers is None or len(running) < workers):
            node = schedule.pop()
            heapq.heappush(running, (now + lasting[node.key], node.key, node))
        most = max(most, len(running))
        if not running:
            return now, most
        now, _, node = heapq.heappop(running)
        schedule.ended(node)
