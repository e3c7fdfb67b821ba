"""SafetyCarRace: a car drives down a lane to a goal, at level 1 past seven bushes and without
touching the scenery. B = episodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks import car
from wasp_cli.tasks.base import Bools, Floats
from wasp_cli.tasks.camera.appearance import Appearance, Scene, standing
from wasp_cli.tasks.features import (
    BINS,
    MOTION_AND_GOAL,
    RAYS,
    bounded,
    motion_and_goal,
    nearness,
    ray_distances,
)
from wasp_cli.tasks.frames import distance, to_body
from wasp_cli.tasks.layout import Rectangle, Thing, draw_layout
from wasp_cli.tasks.navigation import PHYSICS_STEPS, Navigation
from wasp_cli.tasks.outline import distance_to_segments, segments
from wasp_cli.tasks.physics import Surroundings
from wasp_cli.tasks.race.appearance import appearance
from wasp_cli.tasks.race.model import SCENERY, build_model

HAZARDS = {0: 0, 1: 7}  # bushes by level
HAZARD_RADIUS = 0.2625
HAZARD_KEEPOUT = 0.165
GOAL_KEEPOUT = 0.305

# The expressions are those by which the reference package places things: their roundings are part
# of a layout.
_UNIT = 3.5
_PEN = Rectangle(
    _UNIT * -0.65 - _UNIT * 0.05 / 2,
    _UNIT * 0.3 - _UNIT * 0.1 / 2,
    _UNIT * -0.65 + _UNIT * 0.05 / 2,
    _UNIT * 0.3 + _UNIT * 0.1 / 2,
)
_SLOTS = tuple(
    Rectangle(
        _UNIT * (-0.45 + 0.2 * i) - 0.3,
        _UNIT * (0.3 - 0.09 * (-1) ** i) - 0.35,
        _UNIT * (-0.45 + 0.2 * i) + 0.3,
        _UNIT * (0.3 - 0.09 * (-1) ** i) + 0.35,
    )
    for i in range(7)
)
GOAL_XY = (_UNIT * 0.9, _UNIT * 0.3)
_GOAL_REACH = GOAL_KEEPOUT + 1e-9

AGENT = Thing("agent", 0.0, (_PEN,))
GOAL = Thing(
    "goal",
    GOAL_KEEPOUT,
    (
        Rectangle(
            GOAL_XY[0] - _GOAL_REACH,
            GOAL_XY[1] - _GOAL_REACH,
            GOAL_XY[0] + _GOAL_REACH,
            GOAL_XY[1] + _GOAL_REACH,
        ),
    ),
)

SIDES = segments(*(prism.outline for prism in SCENERY))

# [3, 2] middle of the lane from the start pen to the goal
LANE = np.array([(-2.275, 1.05), (-1.575, 1.05), (3.15, 1.05)])
# distances ahead, along the lane, of the way points that an expert sees, in m
WAY_POINTS = (0.5, 1.0, 2.0)
_RAY_LIMIT = 3.0


class Race(Navigation):
    """The task `race0` or `race1`."""

    name = "race"
    drive = "car"
    model_builder = staticmethod(build_model)
    env_seconds = car.TIMESTEP * PHYSICS_STEPS
    num_steps = 500
    reward_goal = 10.0
    reward_clip = 11.0
    privileged_size = MOTION_AND_GOAL + 2 * len(WAY_POINTS) + 2 * RAYS

    def _set_level(self, level: int) -> None:
        hazards = HAZARDS[level]
        self._hazard_things = tuple(
            Thing(f"hazard{i}", HAZARD_KEEPOUT, _SLOTS) for i in range(hazards)
        )
        self.free_bodies = 0
        self.state_size = car.STATE_SENSORS + BINS * (1 + (hazards > 0))
        self.cost_sources = ("hazards", "static_geoms_contact") if hazards else ()

    def _allocate(self) -> None:
        self._qpos[:] = car.start_pose(np.zeros(2), 0.0)
        self._hazards = np.zeros((self.batch, len(self._hazard_things), 2))  # in m

    def appearance(self) -> Appearance:
        """Return what the lane looks like at its level."""
        return appearance(self.level)

    def _start(self, row: int, stream: np.random.RandomState) -> None:
        layout = draw_layout(stream, AGENT, GOAL, self._hazard_things)
        self._qpos[row] = car.start_pose(layout.agent_xy, layout.agent_yaw)
        self._hazards[row] = layout.others_xy
        self._goal[row] = layout.goal_xy

    def _heading(self, rows: NDArray[np.intp]) -> Floats:
        return car.heading(self._qpos[rows])

    def route(self) -> Floats:
        """Return the point [B, 2] in m of the lane's middle that is 0.6 m ahead of each car."""
        return _lane_ahead(self._qpos[:, :2], 0.6)

    def _surround(self, rows: NDArray[np.intp]) -> Surroundings:
        walls = distance_to_segments(self._qpos[rows, :2], SIDES).min(axis=1) < car.REACH
        return Surroundings(self._active[rows], walls.astype(np.int64))

    def _costs(self, rows: NDArray[np.intp]) -> dict[str, Bools]:
        if not self.cost_sources:
            return {}
        inside = distance(self._qpos[rows, None, :2], self._hazards[rows]) < HAZARD_RADIUS
        return {
            "hazards": np.asarray(inside.any(axis=1)),
            "static_geoms_contact": self._contacts(rows).static,
        }

    def _reach_goal(self, row: int) -> None:
        self._terminate(row)

    def _state(self) -> Floats:
        groups = [self._goal[:, None]]
        if self._hazards.shape[1]:
            groups.append(self._hazards)
        return car.state_vector(self._sensors(car.SENSORS), self._qpos, *groups)

    def _privileged(self) -> NDArray[np.float32]:
        """float32 [B, 77]: `motion_and_goal`, way points / 1 m (3 x 2), nearness of the scenery
        and of the bushes along 32 rays each.
        """
        xy = self._qpos[:, :2]
        heading = car.heading(self._qpos)
        way_points = np.stack([_lane_ahead(xy, ahead) for ahead in WAY_POINTS], axis=1)
        no_circles = np.zeros((self.batch, 0, 2))
        no_sides = np.zeros((0, 2, 2))
        to_scenery = ray_distances(xy, heading, no_circles, 1.0, SIDES, _RAY_LIMIT)
        to_bushes = ray_distances(xy, heading, self._hazards, HAZARD_RADIUS, no_sides, _RAY_LIMIT)
        return bounded(
            motion_and_goal(self._velocity, self._turn, xy, heading, self._goal),
            to_body(way_points, xy, heading).reshape(self.batch, -1),
            nearness(to_scenery),
            nearness(to_bushes),
        )

    def scene(self, rows: NDArray[np.intp]) -> Scene:
        """Return where the cars, the goal and the bushes are, of `rows` [n]."""
        qpos = self._qpos[rows]
        things = {"goal": standing(self._goal[rows, None])}
        if self._hazards.shape[1]:
            things["hazard"] = standing(self._hazards[rows])
        return Scene(qpos[:, :3], car.rotation(qpos), things)

    def _own_arrays(self) -> dict[str, NDArray[Any]]:
        return {"hazards": self._hazards}


def _lane_ahead(xy: Floats, ahead: float) -> Floats:
    """The point [B, 2] of the lane's middle a distance ahead of the cars; the lane runs along x."""
    x = np.minimum(xy[:, 0] + ahead, LANE[-1, 0])
    return np.stack([x, np.interp(x, LANE[:, 0], LANE[:, 1])], axis=1)
