"""A node: one unit of work, identified by everything that decides its bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any


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

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and other.key == self.key

    def __str__(self) -> str:
        return self.label


def with_upstream(nodes: Iterator[Node] | list[Node]) -> list[Node]:
    """The nodes and everything they need, each once, needed ones first."""
    found: dict[str, Node] = {}

    def visit(node: Node) -> None:
        if node.key not in found:
            for needed in node.needs.values():
                visit(needed)
            found[node.key] = node

    for node in nodes:
        visit(node)
    return list(found.values())
