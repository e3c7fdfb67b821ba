"""Goal1 with a second goal of equal look: one of the two is the operator's, and no camera shows
which.

Where the operator's is reached both are drawn anew, so that nothing seen before tells the new ones
apart. The other gives nothing and stays.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.batch import Totals
from wasp_cli.tasks.camera.appearance import Appearance, Kind, Scene, standing
from wasp_cli.tasks.features import lidars
from wasp_cli.tasks.frames import distance, to_body
from wasp_cli.tasks.goal import model as g
from wasp_cli.tasks.goal.task import Goal
from wasp_cli.tasks.layout import draw_goal

_MARK = Kind("mark", '<geom type="cylinder" size="0.1 0.01"/>', (1.0, 0.0, 1.0), reach=0.0)
"""Lies on the operator's goal, for people: maps draw it, and cameras draw nothing beyond its
reach.
"""


class TwoGoals(Goal):
    """The task `goal1-two`; all else is as in Goal1, the privileged vector too: the goal in it
    is the operator's.
    """

    def _set_level(self, level: int) -> None:
        if level != 1:
            raise TaskError(f"goal1-two has level 1 alone, not {level}")
        super()._set_level(level)

    def _allocate(self) -> None:
        super()._allocate()
        self._other = np.zeros((self.batch, 2))  # in m, the goal that is not the operator's
        self._within = np.zeros(self.batch, np.bool_)  # whether the robot is in it
        self._wrong = np.zeros(self.batch, np.int64)  # how often it was entered

    def appearance(self) -> Appearance:
        """Return the appearance of Goal1, with a mark for people."""
        plain = super().appearance()
        return plain._replace(kinds=(*plain.kinds, _MARK))

    def tallies(self) -> dict[str, NDArray[np.int64]]:
        """Return what else was counted in the present episodes [B], by name: how often the goal
        was entered that is not the operator's.
        """
        return {"wrong_goals": self._wrong.copy()}

    def _start(self, row: int, stream: np.random.RandomState) -> None:
        super()._start(row, stream)
        self._within[row] = False
        self._wrong[row] = 0
        if not self._draw_other(row, stream):
            raise TaskError("no layout found: there is no free place for a second goal")

    def _reach_goal(self, row: int) -> None:
        """Two new goals, clear of each other and of where everything is now."""
        super()._reach_goal(row)
        if not self._terminated[row] and not self._draw_other(row, self._streams.catch_up(row)):
            self._terminate(row)

    def _draw_other(self, row: int, stream: np.random.RandomState) -> bool:
        """Draw a second goal beside the one that was drawn just now, and toss whose is whose;
        False where there is no place for it.
        """
        obstacles_xy = np.concatenate(
            [
                self._qpos[row, None, :2],
                self._hazards[row],
                self._bodies[row, :, :2],
                self._goal[row, None],
            ]
        )
        other = draw_goal(
            stream,
            self._goal_thing,
            (self._agent_thing, *self._others, self._goal_thing),
            obstacles_xy,
        )
        if other is None:
            return False
        self._other[row] = other
        # The first was drawn without regard to the second: only the toss makes the two alike in
        # distribution as well.
        if stream.random_sample() < 0.5:
            first = self._goal[row].copy()
            self._goal[row] = self._other[row]
            self._other[row] = first
        return True

    def _env_step(self, rows: NDArray[np.intp], totals: Totals) -> None:
        super()._env_step(rows, totals)
        within = distance(self._qpos[rows, :2], self._other[rows]) <= self.goal_radius
        self._wrong[rows] += within & ~self._within[rows]
        self._within[rows] = within

    def _pair(self, rows: NDArray[np.intp]) -> Floats:
        """Both goals [n, 2, 2] by their places, whosever they are."""
        pair = np.stack([self._goal[rows], self._other[rows]], axis=1)
        order = np.lexsort((pair[..., 1], pair[..., 0]), axis=1)
        return np.take_along_axis(pair, order[..., None], axis=1)

    def _state(self) -> Floats:
        """As Goal1's, but the lidar of goals sees both."""
        kinds = [self._pair(np.arange(self.batch)), self._hazards, self._bodies[..., :2]]
        around = to_body(np.concatenate(kinds, axis=1), self._qpos[:, :2], self._qpos[:, 2])
        lidar = lidars(around, [points.shape[1] for points in kinds])
        return np.concatenate([self._sensors(g.AGENT_SENSORS), lidar], axis=1)

    def scene(self, rows: NDArray[np.intp]) -> Scene:
        """Return the scene of Goal1 with both goals, and the mark on the operator's."""
        plain = super().scene(rows)
        mark = plain.things["goal"]
        goals = standing(self._pair(rows), g.GOAL_Z)
        return plain._replace(things={**plain.things, "goal": goals, "mark": mark})

    def _own_arrays(self) -> dict[str, NDArray[Any]]:
        return {
            **super()._own_arrays(),
            "other": self._other,
            "within": self._within,
            "wrong": self._wrong,
        }
