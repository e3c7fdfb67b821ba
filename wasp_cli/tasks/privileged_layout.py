"""What the entries of a privileged vector are about, and what they become with left and right
exchanged. P = entries.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.features import RAYS

WHOLE = "all"  # the whole vector; the only group of a task of somebody else's
MOTION, GOAL, WAY, WALLS, THINGS = "motion", "goal", "way", "walls", "things"
ROUND = "round"
"""Rays around the robot, counter-clockwise from its front: their order turns round. Any other part
has a sign per entry: minus where it changes, and a dot where a mirror does not tell it."""

SIGNS = {"+": 1.0, "-": -1.0, ".": 0.0}

Parts = tuple[str, ...]
_MOTION: tuple[str, Parts] = (MOTION, ("+--",))
_GOAL: tuple[str, Parts] = (GOAL, ("+-++",))
_AROUND: tuple[tuple[str, Parts], ...] = ((WALLS, (ROUND,)), (THINGS, (ROUND,)))
_RACE: tuple[tuple[str, Parts], ...] = (_MOTION, (GOAL, ("." * 4,)), (WAY, ("." * 6,)), *_AROUND)
_FORMULA: tuple[tuple[str, Parts], ...] = (
    _MOTION,
    (GOAL, ("." * 5,)),
    (WAY, ("." * 10,)),
    *_AROUND,
)
_GOAL1: tuple[tuple[str, Parts], ...] = (_MOTION, _GOAL, (THINGS, ("+-+" * 8, "+-", ROUND)))
LAYOUTS: dict[str, tuple[tuple[str, Parts], ...]] = {
    "goal0": (_MOTION, _GOAL),
    "goal1": _GOAL1,
    "goal1-two": _GOAL1,
    "goal2": (_MOTION, _GOAL, (THINGS, ("+-+" * 10, "+-" * 10, ROUND))),
    "race0": _RACE,
    "race1": _RACE,
    "formula0": _FORMULA,
    "formula1": _FORMULA,
}
"""By task: the groups in the order of the vector. `things` are those that may cost."""


def privileged_groups(task: str, size: int) -> dict[str, slice]:
    """Find where each group lies in the privileged vector [`size`] of a task: the whole first,
    then the groups that are known.
    """
    groups, begin = {WHOLE: slice(0, size)}, 0
    for name, parts in LAYOUTS.get(task, ()):
        end = begin + sum(map(_entries, parts))
        groups[name] = slice(begin, end)
        begin = end
    return groups


def privileged_mirror(task: str) -> tuple[NDArray[np.int64], NDArray[np.float32]] | None:
    """Find what a privileged vector is in a mirror: `vector[..., order] * sign`, both [P]; a sign
    of 0 marks what it does not tell.

    None where nothing is known of the task's vector.
    """
    if task not in LAYOUTS:
        return None
    order: list[int] = []
    sign: list[float] = []
    for part in (part for _, parts in LAYOUTS[task] for part in parts):
        begin = len(order)
        order += [begin + (-i % RAYS if part == ROUND else i) for i in range(_entries(part))]
        sign += [1.0] * RAYS if part == ROUND else [SIGNS[each] for each in part]
    places: NDArray[Any] = np.array(order, np.int64)
    return places, np.array(sign, np.float32)


def _entries(part: str) -> int:
    return RAYS if part == ROUND else len(part)
