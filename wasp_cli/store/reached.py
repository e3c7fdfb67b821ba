"""Everything that is reached step by step, such as all that a node needs, or a module imports."""

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
