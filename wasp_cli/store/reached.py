"""Everything that can be reached: what a node needs, through other nodes too; what a module
imports; what reads something.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import TypeVar

Item = TypeVar("Item", bound=Hashable)


def reached(start: Iterable[Item], further: Callable[[Item], Iterable[Item]]) -> set[Item]:
    """Return some things, and everything that `further` leads to from them, step by step."""
    found: set[Item] = set()
    pending = list(start)
    while pending:
        item = pending.pop()
        if item not in found:
            found.add(item)
            pending += further(item)
    return found
