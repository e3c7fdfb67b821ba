"""What the entries of a privileged vector are about, so that a readout can be judged by kind of knowledge."""

from __future__ import annotations

from wasp_cli.tasks.features import RAYS

MOTION, GOAL, WAY, WALLS, THINGS = "motion", "goal", "way", "walls", "things"
WHOLE = "all"
"""The whole vector; the only group of a task of somebody else's."""
SIZES: dict[str, tuple[tuple[str, int], ...]] = {
    "goal": ((MOTION, 3), (GOAL, 4)),
    "race": ((MOTION, 3), (GOAL, 4), (WAY, 6), (WALLS, RAYS)),
    "formula": ((MOTION, 3), (GOAL, 5), (WAY, 10), (WALLS, RAYS)),
}
"""By our task without its level: the groups in the order of the vector and their entries. What is left are the things that may cost."""


def privileged_groups(task: str, size: int) -> dict[str, slice]:
    """Find where each group lies in the privileged vector of a task.

    Args:
        task: its name in the registry.
        size: P, entries of the vector.

    Returns:
        The whole vector first, then the groups that have an entry.
    """
    groups, begin = {WHOLE: slice(0, size)}, 0
    for name, entries in SIZES.get(task.rstrip("0123456789"), ()):
        groups[name] = slice(begin, begin + entries)
        begin += entries
    return groups | ({THINGS: slice(begin, size)} if 0 < begin < size else {})
