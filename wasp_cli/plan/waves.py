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

    def level(node: Node) -> int:
        if node.key not in levels:
            levels[node.key] = 1 + max((level(needed) for needed in node.needs.values() if needed.key in members), default=-1)
        return levels[node.key]

    result: list[list[Node]] = []
    for node in members.values():
        while len(result) <= level(node):
            result.append([])
        result[level(node)].append(node)
    return result
