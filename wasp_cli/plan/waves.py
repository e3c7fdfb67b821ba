"""Topological levels: what can run side by side."""

from __future__ import annotations

from collections.abc import Iterable

from wasp_cli.plan.node import Node


def waves(nodes: Iterable[Node]) -> list[list[Node]]:
    """Split nodes into levels, so that what a node needs lies in an earlier one. Stable: within a level, input order stays.

    Only needs among `nodes` count: what is already computed is left out by the caller, and moves its dependents forward.
    """
    members = {node.key: node for node in nodes}
    levels: dict[str, int] = {}

    def place(node: Node) -> int:
        level = 0
        for needed in node.needs.values():
            if needed.key in members:
                known = levels.get(needed.key)
                level = max(level, 1 + (place(members[needed.key]) if known is None else known))
        levels[node.key] = level
        return level

    result: list[list[Node]] = []
    for node in members.values():
        level = place(node)
        while len(result) <= level:
            result.append([])
        result[level].append(node)
    return result
