"""Pictures of a task for people: from above, which needs no OpenGL, and from behind the robot, which does. None is an observation.

Apart from the tasks themselves, so that a nicer picture makes no result stale. MuJoCo is imported by what draws, since the names of views
are wanted without it too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from wasp_cli.tasks.base import HasScene, Pixels
from wasp_cli.tasks.mujoco_import import require_mujoco

if TYPE_CHECKING:
    from wasp_cli.tasks.camera.view3d import View3D

ViewName = Literal["map", "chase"]
MAP_SIZE, CHASE_SIZE = 256, (480, 360)
"""Pixels: the side of a map, width and height of a view from behind."""


def from_above(task: HasScene, row: int, size: int = MAP_SIZE) -> Pixels:
    """One episode as a map: uint8 [size, size, 3], +x to the right, +y up."""
    require_mujoco()
    from wasp_cli.tasks.camera.topdown import draw_map

    return draw_map(task.look(), task.scene(np.array([row])), 0, size)


class Viewer:
    """Draws episodes of one task in one way; an OpenGL context is opened with the first picture that needs it.

    Raises:
        UsageError: by `draw`, where OpenGL is needed and cannot be used.
    """

    def __init__(self, task: HasScene, view: ViewName = "map") -> None:
        self._task, self._view = task, view
        self._chase: View3D | None = None

    def draw(self, row: int) -> Pixels:
        """uint8 [height, width, 3] of one episode."""
        if self._view == "map":
            return from_above(self._task, row)
        if self._chase is None:
            require_mujoco()
            from wasp_cli.tasks.camera.view3d import View3D

            self._chase = View3D(self._task.look(), *CHASE_SIZE)
        return self._chase.render(self._task.scene(np.array([row])), 0)

    def close(self) -> None:
        """Give an OpenGL context back."""
        if self._chase is not None:
            self._chase.close()
            self._chase = None
