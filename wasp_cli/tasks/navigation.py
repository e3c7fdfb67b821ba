"""What our own tasks share: a batch of robots that drive to goals, advanced one decision step at
a time. B = episodes side by side, A = action size, F = free bodies of an episode.

An env step is 10 physics steps under a held action, then reward, cost, what happens at a reached
goal, and the time limit, in this order. A decision step is `action_repeat` env steps. Every env
step is a pure function of its row's own state: results do not depend on the batch size, the other
rows, the number of threads, or how decision steps cut the time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats, Observation, Pixels, Step
from wasp_cli.tasks.batch import (
    Totals,
    check_begun,
    check_options,
    checked_action,
    chosen_rows,
    running_rows,
)
from wasp_cli.tasks.camera.appearance import Appearance, Scene
from wasp_cli.tasks.camera.camera import Camera
from wasp_cli.tasks.frames import distance, wrapped
from wasp_cli.tasks.layout import Streams
from wasp_cli.tasks.physics import (
    BODY_POSE,
    BODY_SPEED,
    Contacts,
    LocalPhysics,
    ModelBuilder,
    State,
    Surroundings,
)

PHYSICS_STEPS = 10  # physics steps per env step
_JUMP = 1.0  # way in m that no robot drives within an env step


class Pose(NamedTuple):
    """Where the robots are."""

    position: Floats  # [B, 2] in m
    heading: Floats  # [B] direction of the front in rad
    velocity: Floats  # [B, 2] in m/s, over the last env step


class Navigation(ABC):
    """A `VectorTask`; see there for the meaning of its public members. Subclasses say what
    moves, what costs and what is seen.
    """

    # -- what a task is ----------------------------------------------------------------------------

    name: ClassVar[str]
    model_builder: ClassVar[ModelBuilder]  # makes the MuJoCo models of its physics
    env_seconds: ClassVar[float]  # simulated time of one env step in seconds
    num_steps: ClassVar[int]  # time limit in env steps
    goal_radius: ClassVar[float] = 0.3  # distance in m at which a goal is reached
    reward_goal: ClassVar[float]
    reward_clip: ClassVar[float]  # bound of the reward of an env step
    drive: ClassVar[Literal["point", "car"]]
    """What the two actions mean: throttle and turn rate, or the torques of the driver's right
    and left wheel.
    """
    action_size = 2

    # -- what its level decides (`_set_level`) -----------------------------------------------------

    level: int
    free_bodies: int  # F
    privileged_size: int
    state_size: int
    cost_sources: tuple[str, ...]

    @abstractmethod
    def _set_level(self, level: int) -> None:
        """Set the four attributes above, and whatever else the level decides: what there is to be
        placed. Raises KeyError where there is no such level.
        """

    @abstractmethod
    def _allocate(self) -> None:
        """Allocate the arrays of the subclass for `batch` episodes, and set the poses of a batch in
        which no episode has begun.
        """

    # -- what happens in it ------------------------------------------------------------------------

    @abstractmethod
    def appearance(self) -> Appearance:
        """Return what it looks like."""

    @abstractmethod
    def _start(self, row: int, stream: np.random.RandomState) -> None:
        """Lay out a new episode, its goal included; everything is at rest already."""

    @abstractmethod
    def route(self) -> Floats:
        """Return the next point [B, 2] in m on the way to each goal, for the scripted driver."""

    @abstractmethod
    def _heading(self, rows: NDArray[np.intp]) -> Floats:
        """Direction [n] of the robots' front in rad."""

    @abstractmethod
    def _surround(self, rows: NDArray[np.intp]) -> Surroundings:
        """What takes part in the next env step's physics."""

    @abstractmethod
    def _costs(self, rows: NDArray[np.intp]) -> dict[str, Bools]:
        """Whether each source costs now [n], by the names of `cost_sources`."""

    @abstractmethod
    def _reach_goal(self, row: int) -> None:
        """What happens when a goal is reached: a new goal, or the end (`_terminate`)."""

    @abstractmethod
    def _state(self) -> Floats:
        """The state vectors [B, S] of all rows."""

    @abstractmethod
    def _privileged(self) -> NDArray[np.float32]:
        """The privileged vectors [B, P] of all rows."""

    @abstractmethod
    def scene(self, rows: NDArray[np.intp]) -> Scene:
        """Return what the cameras see, of `rows` [n]."""

    @abstractmethod
    def _own_arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays [B, ...] of the subclass that determine the future, by name: what is not
        pose, velocity, goal or counter.
        """

    # -- construction ------------------------------------------------------------------------------

    def __init__(
        self,
        batch: int,
        *,
        level: int = 1,
        action_repeat: int = 4,
        observe: Sequence[str] = ("pixels", "state", "privileged"),
        threads: int = 1,
    ) -> None:
        """Build B = `batch` episodes, of which none has begun.

        Args:
            batch: episodes side by side.
            level: of difficulty, as the reference package numbers them: 0 has nothing that costs.
            action_repeat: env steps per decision step.
            observe: which fields of `Observation` to fill.
            threads: threads for physics and cameras; results do not depend on it.

        Raises:
            KeyError: the task has no such level.
            TaskError: a number is below 1, or `observe` has an unknown name.
        """
        check_options(batch, action_repeat, threads, observe)
        self.batch = batch
        self.action_repeat = action_repeat
        self.observe = tuple(observe)
        self.action_low = np.full(2, -1.0)
        self.action_high = np.full(2, 1.0)
        self.decision_seconds = self.env_seconds * action_repeat
        self.max_decisions = -(-self.num_steps // action_repeat)
        self.level = level
        self._set_level(level)
        bodies = self.free_bodies

        # The world: the state of the physics, and what takes part in the next env step. The latter
        # follows from the other arrays (`_refresh`), so that no snapshot needs it.
        self._physics = LocalPhysics(self.model_builder, threads)
        self._qpos = np.zeros((batch, self._physics.nq))
        self._qvel = np.zeros((batch, self._physics.nv))
        self._bodies = np.zeros((batch, bodies, BODY_POSE))
        self._speeds = np.zeros((batch, bodies, BODY_SPEED))
        self._active = np.zeros((batch, bodies), np.bool_)
        self._walls = np.zeros(batch, np.int64)

        # The episodes.
        self._control = np.zeros((batch, self.action_size))
        # world velocity over the last env step in m/s; the instantaneous one chatters
        self._velocity = np.zeros((batch, 2))
        self._turn = np.zeros(batch)  # turn rate over the last decision step in rad/s
        self._goal = np.zeros((batch, 2))
        self._env_steps = np.zeros(batch, np.int64)
        self._ended = np.ones(batch, np.bool_)
        self._terminated = np.zeros(batch, np.bool_)
        # an episode was started here: before that a row's arrays describe no world
        self._begun = np.zeros(batch, np.bool_)
        self._streams = Streams(batch)

        # What is seen of them.
        self._camera = Camera(self.appearance(), threads) if "pixels" in self.observe else None
        self._pixels: Pixels = np.zeros((batch, 6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)

        self._allocate()

    # -- episodes ----------------------------------------------------------------------------------

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        """Start new episodes; see `VectorTask`."""
        chosen = list(chosen_rows(self.batch, seeds, rows))
        for row, seed in chosen:
            for zeroed in (
                self._control,
                self._velocity,
                self._turn,
                self._env_steps,
                self._ended,
                self._terminated,
            ):
                zeroed[row] = 0
            self._qvel[row] = 0.0
            self._speeds[row] = 0.0
            self._start(row, self._streams.start(row, seed))
        started = np.array([row for row, _ in chosen], np.intp)
        self._begun[started] = True
        self._refresh(started)
        return self._observe(started)

    def step(self, action: NDArray[Any]) -> Step:
        """Advance every unfinished episode by one decision step; see `VectorTask`."""
        control = checked_action(action, self.batch, self.action_size)
        rows = running_rows(self._ended)
        self._control[rows] = control[rows]
        heading = self._heading(rows)
        totals = Totals.zeros(self.batch, self.cost_sources)
        for _ in range(self.action_repeat):
            running = np.flatnonzero(~self._ended)
            if running.size:
                self._env_step(running, totals)
        turned = wrapped(self._heading(rows) - heading)
        self._turn[rows] = turned / (totals.env_steps[rows] * self.env_seconds)
        return totals.as_step(self._observe(rows), self._ended, self._terminated)

    def _env_step(self, rows: NDArray[np.intp], totals: Totals) -> None:
        """Advance some rows [n], all of them running, by one env step, and add it to the totals."""
        # What waits for the first env step of an episode.
        fresh = rows[self._env_steps[rows] == 0]
        if fresh.size:
            self._settle(fresh)
            self._refresh(fresh)
        # Physics under a held action.
        origin = self._qpos[rows, :2]
        before = distance(origin, self._goal[rows])
        state = self._physics.advance(
            self._physical(rows), self._control[rows], self._around(rows), PHYSICS_STEPS
        )
        self._qpos[rows] = state.qpos
        self._qvel[rows] = state.qvel
        self._bodies[rows] = state.bodies
        self._speeds[rows] = state.speeds
        xy = self._qpos[rows, :2]
        way = distance(xy, origin)
        if not (way < _JUMP).all():
            # MuJoCo starts a state that it finds unstable anew, at the origin, and only writes a
            # line into a log.
            raise TaskError(
                f"the physics of row {rows[np.argmin(way < _JUMP)]} became unstable: its "
                "robot jumped"
            )
        self._velocity[rows] = (xy - origin) / self.env_seconds
        self._streams.count_step(rows)
        self._env_steps[rows] += 1
        self._refresh(rows)

        # Reward.
        after = distance(xy, self._goal[rows])
        reached = after <= self.goal_radius
        reward = before - after + self.reward_goal * reached
        totals.reward[rows] += np.clip(reward, -self.reward_clip, self.reward_clip)
        # Cost.
        costly = np.zeros(len(rows), np.bool_)
        for source, costs in self._costs(rows).items():
            totals.sources[source][rows] += costs
            costly |= costs
        totals.cost[rows] += costly
        totals.goals[rows] += reached
        totals.env_steps[rows] += 1
        # Goals that were reached, and the time limit.
        for row in rows[reached].tolist():
            self._reach_goal(row)
        self._ended[rows] |= self._env_steps[rows] >= self.num_steps

    def _terminate(self, row: int) -> None:
        self._ended[row] = True
        self._terminated[row] = True

    def pose(self) -> Pose:
        """Return where all robots are."""
        heading = self._heading(np.arange(self.batch))
        return Pose(self._qpos[:, :2].copy(), heading, self._velocity.copy())

    def costs(self) -> dict[str, Bools]:
        """Tell whether each source costs in the present state [B]."""
        return self._costs(np.arange(self.batch))

    # -- physics -----------------------------------------------------------------------------------

    def _settle(self, rows: NDArray[np.intp]) -> None:
        """What changes in the world with the first env step of an episode, before physics."""
        return

    def _physical(self, rows: NDArray[np.intp]) -> State:
        return State(self._qpos[rows], self._qvel[rows], self._bodies[rows], self._speeds[rows])

    def _around(self, rows: NDArray[np.intp]) -> Surroundings:
        return Surroundings(self._active[rows], self._walls[rows])

    def _refresh(self, rows: NDArray[np.intp]) -> None:
        around = self._surround(rows)
        self._active[rows] = around.active
        self._walls[rows] = around.walls

    def _contacts(self, rows: NDArray[np.intp]) -> Contacts:
        """What the robots touch now."""
        return self._physics.contacts(self._physical(rows), self._control[rows], self._around(rows))

    def _sensors(self, count: int) -> Floats:
        """The first `count` sensor numbers [B, count] of all rows."""
        rows = np.arange(self.batch)
        return self._physics.sensors(self._physical(rows), self._control, self._around(rows), count)

    # -- observation -------------------------------------------------------------------------------

    def _observe(self, changed: NDArray[np.intp]) -> Observation:
        """What was asked for of all rows; images are drawn of the rows `changed` [n] alone."""
        pixels: Pixels | None = None
        state: Floats | None = None
        privileged: NDArray[np.float32] | None = None
        if self._camera is not None:
            self._pixels[changed] = self._camera.render(self.scene(changed))
            pixels = self._pixels.copy()
        if "state" in self.observe:
            state = self._state()
        if "privileged" in self.observe:
            privileged = self._privileged()
        return Observation(pixels, state, privileged)

    # -- snapshot ----------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {
            "qpos": self._qpos,
            "qvel": self._qvel,
            "bodies": self._bodies,
            "speeds": self._speeds,
            **self._own_arrays(),
            "control": self._control,
            "velocity": self._velocity,
            "turn": self._turn,
            "goal": self._goal,
            "env_steps": self._env_steps,
            "ended": self._ended,
            "terminated": self._terminated,
        }

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return everything that determines the future of every row; see `VectorTask`."""
        check_begun(self._begun)
        copies = {name: array.copy() for name, array in self._arrays().items()}
        return copies | self._streams.snapshot()

    def restore(self, snapshot: Mapping[str, NDArray[Any]]) -> Observation:
        """Return to a snapshot; see `VectorTask`.

        Raises:
            TaskError: an array of the snapshot is missing, has another shape, or is not finite.
        """
        for name, array in (self._arrays() | self._streams.snapshot()).items():
            if name not in snapshot or snapshot[name].shape != array.shape:
                what = f"{self.name}{self.level} with batch {self.batch}"
                raise TaskError(
                    f"the snapshot is not one of {what}: '{name}' is missing or has another shape"
                )
            if snapshot[name].dtype.kind == "f" and not np.isfinite(snapshot[name]).all():
                raise TaskError(f"the snapshot contains NaN or infinity in '{name}'")
        for name, array in self._arrays().items():
            array[...] = snapshot[name]
        self._streams.restore(
            snapshot["stream_key"], snapshot["stream_position"], snapshot["stream_owed"]
        )
        self._begun[:] = True
        self._refresh(np.arange(self.batch))
        return self._observe(np.arange(self.batch))
