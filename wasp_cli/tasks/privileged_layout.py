"""What the entries of a privileged vector are about, and what they become with left and right
exchanged. P = entries.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.features import RAYS

WHOLE = "all"  # the whole vector; the only group of an environment of others
MOTION = "motion"
GOAL = "goal"
WAY = "way"
WALLS = "walls"
THINGS = "things"
ROUND = "round"
"""A part of rays around the robot, counter-clockwise from its front: a mirror reverses their order.
Any other part has a sign per entry: minus where a mirror changes the sign, and a dot where the
value in the mirror does not follow from the vector."""
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
    """Return where each group lies in the privileged vector [`size`] of a task, by name: the whole
    first, then the groups of `LAYOUTS`.
    """
    groups = {WHOLE: slice(0, size)}
    begin = 0
    for name, parts in LAYOUTS.get(task, ()):
        end = begin + sum(map(_entries, parts))
        groups[name] = slice(begin, end)
        begin = end
    return groups


def privileged_mirror(task: str) -> tuple[NDArray[np.int64], NDArray[np.float32]] | None:
    """Return order and sign, both [P], of a privileged vector in a mirror: there it is
    `vector[..., order] * sign`. A sign of 0 marks a value that does not follow from the vector.

    None where the layout of the task's vector is not known.
    """
    if task not in LAYOUTS:
        return None
    order: list[int] = []
    sign: list[float] = []
    for _, parts in LAYOUTS[task]:
        for part in parts:
            begin = len(order)
            if part == ROUND:
                order += [begin + -ray % RAYS for ray in range(RAYS)]
                sign += [1.0] * RAYS
            else:
                order += range(begin, begin + len(part))
                sign += [SIGNS[letter] for letter in part]
    places: NDArray[Any] = np.array(order, np.int64)
    return places, np.array(sign, np.float32)


def _entries(part: str) -> int:
    """How many entries of the vector a part has."""
    return RAYS if part == ROUND else len(part)
