"""A node: one unit of work, identified by everything that decides its bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from wasp_cli.plan.keys import canonical


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """One run of one stage. Two nodes with the same key produce the same bytes, so the key is the node."""

    kind: str
    task: str
    seed: int
    axes: Mapping[str, Any]
    """What else identifies it: method, method_config, operator variant, value (evaluate, calibration), and the round after the first."""
    config: Mapping[str, Any]
    """The section of its stage, resolved, as JSON values."""
    settings: Mapping[str, Any]
    """The shared settings that its stage named."""
    needs: Mapping[str, Node]
    """The nodes whose artifacts it reads, by the name under which its stage reads them: mostly their kind."""
    modules: tuple[str, ...]
    """Where its code begins; its key covers what these import."""
    key: str
    label: str
    """For people: `goal1 s0 world_model`."""
    sort: str
    """Nodes of a sort take about as long: the same stage, task, method and round at the same sizes, whatever the seed and the operator."""

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and other.key == self.key

    def __str__(self) -> str:
        return self.label


def with_upstream(nodes: Iterable[Node]) -> list[Node]:
    """The nodes and everything they need, each once, needed ones first."""
    found: dict[str, Node] = {}

    def visit(node: Node) -> None:
        for needed in node.needs.values():
            if needed.key not in found:
                visit(needed)
        found[node.key] = node

    for node in nodes:
        if node.key not in found:
            visit(node)
    return list(found.values())


def sort_of(kind: str, task: str, config: Mapping[str, Any], axes: Mapping[str, Any]) -> str:
    """What `Node.sort` is; a manifest tells the same four things of a node that was computed."""
    text = canonical([kind, task, config, axes.get("method"), axes.get("method_config"), axes.get("round")])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
