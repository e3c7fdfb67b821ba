"""SafetyCarFormulaOne: a car follows a walled circuit from stage to stage, at level 1 among 200
barrels.

B = episodes side by side, F = barrels. Only the barrels near the car and those that still roll take
part in the physics. In the reference package all 200 do, and those that start within a barrier
(some 35) are hurled out of it, up to 90 m far; here they are set down beside it, once, with the
first env step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks import car
from wasp_cli.tasks.base import Bools, Floats
from wasp_cli.tasks.camera.appearance import Appearance, Scene, Things, standing
from wasp_cli.tasks.features import (
    BINS,
    MOTION_AND_GOAL,
    RAYS,
    bounded,
    motion_and_goal,
    nearness,
    ray_distances,
)
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.formula.appearance import appearance
from wasp_cli.tasks.formula.model import BARREL_RADIUS, build_model, clear_of_barriers, sectors
from wasp_cli.tasks.frames import quaternion_rotation, to_body, yaw_quaternion
from wasp_cli.tasks.layout import Rectangle, Thing, draw_layout, square
from wasp_cli.tasks.navigation import PHYSICS_STEPS, Navigation
from wasp_cli.tasks.outline import distance_to_segments
from wasp_cli.tasks.physics import Surroundings, active_bodies

BARRELS = {0: 0, 1: 200}  # by level
BARREL_KEEPOUT = 0.5
GOAL_KEEPOUT = 0.305

_DELTA = 1e-9
AGENT = Thing(
    "agent",
    0.0,
    tuple(
        Rectangle(x - _DELTA, y - _DELTA, x + _DELTA, y + _DELTA) for x, y in track.STAGES.tolist()
    ),
)
# The reference package draws a place for the goal as everywhere, keeps the barrels off it, and then
# uses the stages.
GOAL = Thing("goal", GOAL_KEEPOUT, square(2.0))
_BARREL_PLACES = (Rectangle(-12.2, -32.5, 27.8, 7.5), Rectangle(26.0, -11.0, 38.0, 1.0))

_REACH = car.REACH + BARREL_RADIUS
_APART = 2.0 * BARREL_RADIUS + 0.04
_LYING = 0.25  # how much farther from its origin a tilted barrel reaches, in m
_REST = 1e-3  # largest entry of a barrel's velocity that counts as rest, in m/s or rad/s
_MAX_DISTANCE = 3.0  # beyond which a barrel stands still, in m

# distances ahead, along the lap, of the way points that an expert sees, in m
WAY_POINTS = (1.0, 2.0, 4.0, 8.0)
_RAY_LIMIT = 4.0


class Formula(Navigation):
    """The task `formula0` or `formula1`."""

    name = "formula"
    drive = "car"
    model_builder = staticmethod(build_model)
    env_seconds = car.TIMESTEP * PHYSICS_STEPS
    num_steps = 1000
    reward_goal = 10.0
    reward_clip = 11.0
    privileged_size = MOTION_AND_GOAL + 1 + 2 + 2 * len(WAY_POINTS) + 2 * RAYS

    def _set_level(self, level: int) -> None:
        barrels = BARRELS[level]
        self._barrel_things = tuple(
            Thing(f"vase{i}", BARREL_KEEPOUT, _BARREL_PLACES) for i in range(barrels)
        )
        self.free_bodies = barrels
        self.state_size = car.STATE_SENSORS + BINS * (1 + (barrels > 0))
        self.cost_sources = ("vases_contact", "static_geoms_contact") if barrels else ()

    def _allocate(self) -> None:
        self._qpos[:] = car.start_pose(np.zeros(2), 0.0)
        self._stage = np.zeros(self.batch, np.int64)  # [B] index of the goal in `track.STAGES`

    def appearance(self) -> Appearance:
        """Return what the circuit looks like at its level."""
        return appearance(self.level)

    def _start(self, row: int, stream: np.random.RandomState) -> None:
        layout = draw_layout(stream, AGENT, GOAL, self._barrel_things, goal_again=False)
        self._qpos[row] = car.start_pose(layout.agent_xy, layout.agent_yaw)
        self._bodies[row] = 0.0
        self._bodies[row, :, :2] = layout.others_xy
        self._bodies[row, :, 3:] = yaw_quaternion(layout.others_yaw)
        self._stage[row] = np.abs(track.STAGES - layout.agent_xy).sum(axis=1).argmin()
        self._reach_goal(row)

    def _reach_goal(self, row: int) -> None:
        """The next stage."""
        self._stage[row] = (self._stage[row] + 1) % len(track.STAGES)
        self._goal[row] = track.STAGES[self._stage[row]]

    def _settle(self, rows: NDArray[np.intp]) -> None:
        """Set barrels that start within a barrier down beside it."""
        for row in rows.tolist():
            self._bodies[row, :, :2] = clear_of_barriers(self._bodies[row, :, :2])

    def _heading(self, rows: NDArray[np.intp]) -> Floats:
        return car.heading(self._qpos[rows])

    def route(self) -> Floats:
        """Return the goal [B, 2] in m where it is less than 2 m ahead along the lap, else the point
        of the lap 1.5 m ahead.
        """
        at = track.progress(self._qpos[:, :2])
        near = track.lap_distance(at, track.progress(self._goal)) < 2.0
        return np.where(near[:, None], self._goal, track.ahead(at, 1.5))

    def _surround(self, rows: NDArray[np.intp]) -> Surroundings:
        xy = self._qpos[rows, :2]
        barrels = self._bodies[rows]
        # A barrel whose axis is tilted (cosine of the tilt from the quaternion) reaches farther.
        upright = 1.0 - 2.0 * (barrels[..., 4] ** 2 + barrels[..., 5] ** 2)
        reach = np.where(upright > 0.9, _REACH, _REACH + _LYING)
        active = active_bodies(
            xy,
            barrels,
            self._speeds[rows],
            reach=reach,
            apart=_APART,
            rest=_REST,
            max_distance=_MAX_DISTANCE,
        )
        # Barriers take part where the car or an active barrel can touch one.
        walls = distance_to_segments(xy, track.SIDES).min(axis=1) < car.REACH
        row, barrel = np.nonzero(active)
        if row.size:
            from_sides = distance_to_segments(barrels[row, barrel, :2], track.SIDES).min(axis=1)
            np.logical_or.at(walls, row, from_sides < _APART)
        return Surroundings(active, np.where(walls, sectors(xy), 0))

    def _costs(self, rows: NDArray[np.intp]) -> dict[str, Bools]:
        if not self.cost_sources:
            return {}
        contacts = self._contacts(rows)
        return {"vases_contact": contacts.bodies, "static_geoms_contact": contacts.static}

    def _state(self) -> Floats:
        groups = [self._goal[:, None]]
        if self._bodies.shape[1]:
            groups.append(self._bodies[..., :2])
        return car.state_vector(self._sensors(car.SENSORS), self._qpos, *groups)

    def _privileged(self) -> NDArray[np.float32]:
        """float32 [B, 82]: `motion_and_goal`; the way to the goal along the lap / 10 m; the offset
        from the lap's centre line to the left and its half width / 2 m; way points / 2 m (4 x 2);
        nearness of the barriers and of the barrels along 32 rays each.
        """
        xy = self._qpos[:, :2]
        heading = car.heading(self._qpos)
        # Where the car is on the lap, and how far left of the centre line.
        at = track.progress(xy)
        centre = track.FINE_LAP[at]
        direction = track.ahead(at, 0.5) - track.ahead(at, -0.5)
        direction = direction / np.maximum(np.sqrt((direction**2).sum(axis=1, keepdims=True)), 1e-9)
        offset = xy - centre[:, :2]
        left = direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
        way_points = np.stack([track.ahead(at, distance) for distance in WAY_POINTS], axis=1)
        # What is around it.
        no_circles = np.zeros((self.batch, 0, 2))
        no_sides = np.zeros((0, 2, 2))
        barrels = self._bodies[..., :2]
        to_barriers = ray_distances(xy, heading, no_circles, 1.0, track.SIDES, _RAY_LIMIT)
        to_barrels = ray_distances(xy, heading, barrels, BARREL_RADIUS, no_sides, _RAY_LIMIT)
        return bounded(
            motion_and_goal(self._velocity, self._turn, xy, heading, self._goal),
            track.lap_distance(at, track.progress(self._goal))[:, None] / 10.0,
            np.stack([left, centre[:, 2]], axis=1) / 2.0,
            to_body(way_points, xy, heading).reshape(self.batch, -1) / 2.0,
            nearness(to_barriers),
            nearness(to_barrels),
        )

    def scene(self, rows: NDArray[np.intp]) -> Scene:
        """Return where the cars, the goal and the barrels are, of `rows` [n]."""
        things = {"goal": standing(self._goal[rows, None])}
        if self._bodies.shape[1]:
            barrels = self._bodies[rows]
            things["vase"] = Things(
                barrels[..., :3],
                quaternion_rotation(barrels[..., 3:]),
                np.ones(barrels.shape[:2], np.bool_),
            )
        qpos = self._qpos[rows]
        return Scene(qpos[:, :3], car.rotation(qpos), things)

    def _own_arrays(self) -> dict[str, NDArray[Any]]:
        return {"stage": self._stage}
