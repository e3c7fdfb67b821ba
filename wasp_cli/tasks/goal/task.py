"""SafetyPointGoal: a point robot collects goals, at level 1 among eight hazards and a vase, for
a batch of B episodes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Bools, Floats
from wasp_cli.tasks.camera.appearance import Appearance, Scene, Things, standing
from wasp_cli.tasks.features import (
    BINS,
    MOTION_AND_GOAL,
    RAYS,
    bounded,
    lidars,
    motion_and_goal,
    nearness,
    ray_distances,
)
from wasp_cli.tasks.frames import (
    distance,
    quaternion_rotation,
    to_body,
    yaw_quaternion,
    yaw_rotation,
)
from wasp_cli.tasks.goal import model as g
from wasp_cli.tasks.goal.appearance import appearance
from wasp_cli.tasks.layout import Thing, draw_goal, draw_layout, square
from wasp_cli.tasks.navigation import PHYSICS_STEPS, Navigation
from wasp_cli.tasks.physics import Surroundings, active_bodies

_RAY_LIMIT = 3.0
_NO_WALLS = np.zeros((0, 2, 2))


def state_size(hazards: int, vases: int) -> int:
    """Return the length of the state vector."""
    return g.AGENT_SENSORS + BINS * (1 + (hazards > 0) + (vases > 0))


def privileged_size(hazards: int, vases: int) -> int:
    """Return the length of the privileged vector."""
    return MOTION_AND_GOAL + 3 * hazards + 2 * vases + (RAYS if hazards else 0)


def state_vector(
    sensors: Floats, pose: Floats, goal: Floats, hazards: Floats, vases: Floats
) -> Floats:
    """Join float64 [B, S]: accelerometer, velocimeter, gyro, magnetometer, then 16 lidar bins of
    goal, hazards, vases (of those there are).

    Args:
        sensors: [B, 12] in this order.
        pose: [B, 3] agent x, y in m, yaw in rad.
        goal: [B, 2] in m.
        hazards: [B, K, 2] in m.
        vases: [B, F, 2] in m.
    """
    kinds = [points for points in (goal[:, None], hazards, vases) if points.shape[1]]
    around = to_body(np.concatenate(kinds, axis=1), pose[:, :2], pose[:, 2])
    return np.concatenate([sensors, lidars(around, [points.shape[1] for points in kinds])], axis=1)


def privileged_vector(
    velocity: Floats, turn: Floats, pose: Floats, goal: Floats, hazards: Floats, vases: Floats
) -> NDArray[np.float32]:
    """Join float32 [B, P], entries within [-3, 3]; everything in the robot's frame, lengths in m
    unless said.

    First `motion_and_goal`; then for each hazard, nearest first, its position / 1.5 (2) and twice
    the clearance from its rim, clipped to [-0.2, 1] m; then the vases' positions / 1.5 (2 each,
    nearest first); last the nearness of hazards along 32 rays.

    Args:
        velocity: [B, 2] mean world velocity over the last env step (the instantaneous sensors
            chatter).
        turn: [B] mean turn rate over the last decision step in rad/s.
        pose: as for `state_vector`; goal, hazards and vases too.
    """
    rows = len(pose)
    xy = pose[:, :2]
    yaw = pose[:, 2]
    parts = [motion_and_goal(velocity, turn, xy, yaw, goal)]
    # Hazards: positions and clearances.
    around, range_ = _nearest_first(to_body(hazards, xy, yaw))
    clearance = 2.0 * np.clip(range_ - g.HAZARD_RADIUS, -g.HAZARD_RADIUS, 1.0)
    positions_and_clearances = np.concatenate([around / 1.5, clearance[..., None]], axis=2)
    parts.append(positions_and_clearances.reshape(rows, -1))
    # Vases.
    vases_around, _ = _nearest_first(to_body(vases, xy, yaw))
    parts.append(vases_around.reshape(rows, -1) / 1.5)
    # Hazards once more, by direction.
    if hazards.shape[1]:
        to_hazards = ray_distances(xy, yaw, hazards, g.HAZARD_RADIUS, _NO_WALLS, _RAY_LIMIT)
        parts.append(nearness(to_hazards))
    return bounded(*parts)


def _nearest_first(points: Floats) -> tuple[Floats, Floats]:
    """Points [B, K, 2] by their distance from the origin, and the distances [B, K]."""
    range_ = np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2)
    order = np.argsort(range_, axis=1, kind="stable")
    nearest_points = np.take_along_axis(points, order[..., None], axis=1)
    nearest_ranges = np.take_along_axis(range_, order, axis=1)
    return nearest_points, nearest_ranges


class Level(NamedTuple):
    """What distinguishes the levels."""

    half_side: float  # half the side of the square that holds everything at the start, in m
    hazards: int
    vases: int
    vases_cost: bool


LEVELS = {0: Level(1.0, 0, 0, False), 1: Level(1.5, 8, 1, False), 2: Level(2.0, 10, 10, True)}

# radii in m that no other thing's keepout circle may enter
AGENT_KEEPOUT = 0.4
GOAL_KEEPOUT = 0.305
HAZARD_KEEPOUT = 0.18
VASE_KEEPOUT = 0.15
VASE_SPEED = 1e-4  # speed in m/s from which a moving vase costs, where vases cost

# The agent's arrow and the corner of a tipped vase reach 0.16 and 0.18 m; within an env step at
# most 0.03 m are driven.
_REACH = 0.4
_REST = 1e-8  # largest entry of a vase's velocity that counts as rest, in m/s or rad/s


class Goal(Navigation):
    """The task `goal0`, `goal1` or `goal2`."""

    name = "goal"
    drive = "point"
    model_builder = staticmethod(g.build_model)
    env_seconds = g.TIMESTEP * PHYSICS_STEPS
    num_steps = 1000
    reward_goal = 1.0
    reward_clip = 10.0

    def _set_level(self, level: int) -> None:
        numbers = LEVELS[level]
        self._numbers = numbers
        # What is placed, and where it may lie.
        places = square(numbers.half_side)
        self._agent_thing = Thing("agent", AGENT_KEEPOUT, places)
        self._goal_thing = Thing("goal", GOAL_KEEPOUT, places)
        hazards = [Thing(f"hazard{i}", HAZARD_KEEPOUT, places) for i in range(numbers.hazards)]
        vases = [Thing(f"vase{i}", VASE_KEEPOUT, places) for i in range(numbers.vases)]
        self._others = (*hazards, *vases)
        # What the task then is for others.
        self.free_bodies = numbers.vases
        self.state_size = state_size(numbers.hazards, numbers.vases)
        self.privileged_size = privileged_size(numbers.hazards, numbers.vases)
        self.cost_sources = ("hazards",) if numbers.hazards else ()
        if numbers.vases_cost:
            self.cost_sources += ("vases_contact", "vases_velocity")

    def _allocate(self) -> None:
        self._hazards = np.zeros((self.batch, self._numbers.hazards, 2))  # in m

    def appearance(self) -> Appearance:
        """Return what the square looks like at its level."""
        return appearance(self.level)

    def _start(self, row: int, stream: np.random.RandomState) -> None:
        layout = draw_layout(stream, self._agent_thing, self._goal_thing, self._others)
        hazards = self._numbers.hazards
        self._qpos[row, :2] = layout.agent_xy
        self._qpos[row, 2] = layout.agent_yaw
        self._hazards[row] = layout.others_xy[:hazards]
        self._bodies[row, :, :2] = layout.others_xy[hazards:]
        self._bodies[row, :, 2] = g.VASE_Z
        self._bodies[row, :, 3:] = yaw_quaternion(layout.others_yaw[hazards:])
        self._goal[row] = layout.goal_xy

    def _heading(self, rows: NDArray[np.intp]) -> Floats:
        heading: Floats = self._qpos[rows, 2]
        return heading

    def route(self) -> Floats:
        """Return the goals [B, 2] in m: nothing stands in the way."""
        return self._goal.copy()

    def _surround(self, rows: NDArray[np.intp]) -> Surroundings:
        active = active_bodies(
            self._qpos[rows, :2],
            self._bodies[rows],
            self._speeds[rows],
            reach=_REACH,
            apart=_REACH,
            rest=_REST,
        )
        # A fresh vase has no speed yet, but falls by a few micrometres before it rests.
        active |= (self._env_steps[rows] == 0)[:, None]
        return Surroundings(active, np.zeros(len(rows), np.int64))

    def _costs(self, rows: NDArray[np.intp]) -> dict[str, Bools]:
        if not self._numbers.hazards:
            return {}
        inside = distance(self._qpos[rows, None, :2], self._hazards[rows]) < g.HAZARD_RADIUS
        costs: dict[str, Bools] = {"hazards": np.asarray(inside.any(axis=1))}
        if self._numbers.vases_cost:
            costs["vases_contact"] = self._contacts(rows).bodies
            speed = np.sqrt((self._speeds[rows, :, :3] ** 2).sum(axis=2))
            costs["vases_velocity"] = (speed >= VASE_SPEED).any(axis=1)
        return costs

    def _reach_goal(self, row: int) -> None:
        """A new goal, clear of where agent, hazards and vases are now."""
        others = np.concatenate(
            [self._qpos[row, None, :2], self._hazards[row], self._bodies[row, :, :2]]
        )
        goal = draw_goal(
            self._streams.catch_up(row),
            self._goal_thing,
            (self._agent_thing, *self._others),
            others,
        )
        if goal is None:
            self._terminate(row)
        else:
            self._goal[row] = goal

    def _state(self) -> Floats:
        return state_vector(
            self._sensors(g.AGENT_SENSORS),
            self._qpos,
            self._goal,
            self._hazards,
            self._bodies[..., :2],
        )

    def _privileged(self) -> NDArray[np.float32]:
        return privileged_vector(
            self._velocity, self._turn, self._qpos, self._goal, self._hazards, self._bodies[..., :2]
        )

    def scene(self, rows: NDArray[np.intp]) -> Scene:
        """Return where the robots, goals, hazards and vases are, of `rows` [n]."""
        vases = self._bodies[rows]
        things = {
            "goal": standing(self._goal[rows, None], g.GOAL_Z),
            "hazard": standing(self._hazards[rows], g.HAZARD_Z),
            "vase": Things(
                vases[..., :3],
                quaternion_rotation(vases[..., 3:]),
                np.ones(vases.shape[:2], np.bool_),
            ),
        }
        present = {name: kind for name, kind in things.items() if kind.position.shape[1]}
        xy = self._qpos[rows, :2]
        position = np.concatenate([xy, np.full((len(rows), 1), g.AGENT_Z)], axis=1)
        return Scene(position, yaw_rotation(self._qpos[rows, 2]), present)

    def _own_arrays(self) -> dict[str, NDArray[Any]]:
        return {"hazards": self._hazards}
