"""From the stick of the page to the numbers of an action, and back.

Our own tasks say whether they are driven as a point or as a car. For an environment of another
package, the spec says which key raises each number of its action (`controls` in its entry of
`tasks`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wasp_cli.drive.desk import FORWARD, LEFT, action_of
from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import Floats, VectorTask
from wasp_cli.tasks.declared import USUAL_CONTROLS
from wasp_cli.video.map import stick

_PUSHES = {
    "up": (FORWARD, 1.0),
    "down": (FORWARD, -1.0),
    "left": (LEFT, 1.0),
    "right": (LEFT, -1.0),
}
"""By key: along which axis of the stick, and which way. `none` pushes nothing."""


class Controls:
    """How a task is driven."""

    def __init__(self, task: VectorTask, keys: Sequence[str] | None = None) -> None:
        """`keys` are those of a spec, one for each number of an action.

        Raises:
            UsageError: neither the spec nor a default says how actions of this size are commanded.
        """
        self._task = task
        self._keys: tuple[str, ...] | None = None
        if getattr(task, "drive", None) is not None:
            return
        own_keys = USUAL_CONTROLS.get(task.action_size) if keys is None else tuple(keys)
        if own_keys is None or len(own_keys) != task.action_size:
            raise UsageError(
                f"there is no rule by which a person commands its {task.action_size} numbers",
                "write `controls` into its entry of `tasks`: for each number one of up, down, "
                "left, right or none",
            )
        self._keys = own_keys

    def action(self, pushed: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action [A] in [-1, 1] that a stick (forward, left) [2] commands."""
        if self._keys is None:
            return action_of(pushed, getattr(self._task, "drive", None))
        action = np.zeros(len(self._keys), np.float32)
        for number, key in enumerate(self._keys):
            if key in _PUSHES:
                axis, way = _PUSHES[key]
                action[number] = way * pushed[axis]
        return action

    def stick(self, action: Floats) -> Floats | None:
        """Return the stick (forward, left) [2] of an action [A], for the page to show: where a key
        raises several numbers, their mean.
        """
        if self._keys is None:
            return stick(self._task, action)
        pushes: dict[int, list[float]] = {FORWARD: [], LEFT: []}
        for number, key in enumerate(self._keys):
            if key in _PUSHES:
                axis, way = _PUSHES[key]
                pushes[axis].append(way * float(action[number]))
        return np.array([np.mean(pushes[axis] or [0.0]) for axis in (FORWARD, LEFT)])

    @property
    def told(self) -> str | None:
        """Which key raises which number, as a sentence for the page; None for our own tasks, which
        are driven as one expects.
        """
        if self._keys is None:
            return None
        raised: dict[str, list[str]] = {}
        for number, key in enumerate(self._keys, start=1):
            raised.setdefault(key, []).append(str(number))
        still = raised.pop("none", [])
        parts = [f"{key} raises number {' and '.join(at)}" for key, at in raised.items()]
        if still:
            parts.append(f"number {' and '.join(still)} stays in the middle")
        return f"Of the command, {', '.join(parts)}."
