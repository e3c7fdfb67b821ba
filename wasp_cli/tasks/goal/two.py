"""Goal1 with a second goal of equal look: one of the two is the operator's, and no camera shows
which.

Where the operator's is reached both are drawn anew, so that nothing seen before tells the new ones
apart. The other gives nothing and stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.batch import Totals
from wasp_cli.tasks.camera.appearance import Appearance, Kind, Scene, Things
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

    def __init__(
        self,
        batch: int,
        *,
        action_repeat: int = 4,
        observe: Sequence[str] = ("pixels", "state", "privileged"),
        threads: int = 1,
    ) -> None:
        self._other = np.zeros((batch, 2))
        self._within, self._wrong = np.zeros(batch, np.bool_), np.zeros(batch, np.int64)
        super().__init__(
            batch, level=1, action_repeat=action_repeat, observe=observe, threads=threads
        )

    def appearance(self) -> Appearance:
        plain = super().appearance()
        return plain._replace(kinds=(*plain.kinds, _MARK))

    def tallies(self) -> dict[str, NDArray[np.int64]]:
        """Return what else was counted in the present episodes [B], by name: how often the goal
        was entered that is not the operator's.
        """
        return {"wrong_goals": self._wrong.copy()}

    def _start(self, row: int, stream: np.random.RandomState) -> None:
        super()._start(row, stream)
        self._within[row], self._wrong[row] = False, 0
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
        taken = np.concatenate(
            [
                self._qpos[row, None, :2],
                self._hazards[row],
                self._bodies[row, :, :2],
                self._goal[row, None],
            ]
        )
        other = draw_goal(
            stream, self._goal_thing, (self._agent_thing, *self._others, self._goal_thing), taken
        )
        if other is None:
            return False
        self._other[row] = other
        # The first was drawn without regard to the second: only the toss makes the two alike in
        # distribution as well.
        if stream.random_sample() < 0.5:
            self._goal[row], self._other[row] = self._other[row].copy(), self._goal[row].copy()
        return True

    def _env_step(self, rows: NDArray[np.intp], totals: Totals) -> None:
        super()._env_step(rows, totals)
        within = distance(self._qpos[rows, :2], self._other[rows]) <= self.goal_radius
        self._wrong[rows] += within & ~self._within[rows]
        self._within[rows] = within

    def _pair(self, rows: NDArray[np.intp]) -> Floats:
        """Both goals [n, 2, 2] by their places, whosever they are."""
        pair = np.stack([self._goal[rows], self._other[rows]], axis=1)
        return np.take_along_axis(
            pair, np.lexsort((pair[..., 1], pair[..., 0]), axis=1)[..., None], axis=1
        )

    def _state(self) -> Floats:
        """As Goal1's, but the lidar of goals sees both."""
        points = [self._pair(np.arange(self.batch)), self._hazards, self._bodies[..., :2]]
        seen = to_body(np.concatenate(points, axis=1), self._qpos[:, :2], self._qpos[:, 2])
        return np.concatenate(
            [self._sensors(g.AGENT_SENSORS), lidars(seen, [each.shape[1] for each in points])],
            axis=1,
        )

    def scene(self, rows: NDArray[np.intp]) -> Scene:
        plain = super().scene(rows)
        mark, pair = plain.things["goal"], self._pair(rows)
        goals = Things(
            np.concatenate([pair, np.full((*pair.shape[:2], 1), g.GOAL_Z)], axis=2),
            np.repeat(mark.rotation, 2, axis=1),
            np.repeat(mark.shown, 2, axis=1),
        )
        return plain._replace(things={**plain.things, "goal": goals, "mark": mark})

    def _own_arrays(self) -> dict[str, NDArray[Any]]:
        return {
            **super()._own_arrays(),
            "other": self._other,
            "within": self._within,
            "wrong": self._wrong,
        }
