"""Physics of a batch: an agent among free bodies and walls, of which only what is near it takes
part.

`BatchPhysics` is MuJoCo's own C loop over rows. Every call starts the solver from zero, so that
nothing but the state carries over: not the neighbours, not the thread, not the past. In
`LocalPhysics`, a body at rest out of reach neither moves nor exerts a force: leaving it out changes
no motion, and saves most of the time. Every row is stepped in the smallest model that holds its
agent, its K active bodies and, when one of them can touch a wall, the walls around.

n = rows, F = free bodies of a row, K = those that are active. Units are m, rad, s and kg, as in
MuJoCo.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from wasp_cli.tasks.base import Bools, Floats
from wasp_cli.tasks.frames import distance

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)


class BatchPhysics:
    """One model stepped for many rows. A row's state is qpos and qvel (these models have no
    other).
    """

    def __init__(self, model: mujoco.MjModel, threads: int = 1) -> None:
        if mujoco.mj_stateSize(model, _STATE) != 1 + model.nq + model.nv:
            raise ValueError("the model has state besides qpos and qvel")
        self.model = model
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout = rollout.Rollout(nthread=threads if threads > 1 else 0)

    def advance(
        self, qpos: Floats, qvel: Floats, control: Floats, steps: int
    ) -> tuple[Floats, Floats]:
        """Advance states by `steps` physics steps under a held control: [n, nq], [n, nv], [n,
        nu] -> [n, nq], [n, nv].
        """
        if len(qpos) == 1:
            data = self._placed(qpos, qvel, control)
            mujoco.mj_step(self.model, data, nstep=steps)
            return data.qpos[None].copy(), data.qvel[None].copy()
        state, _ = self._run(qpos, qvel, control, steps)
        nq = self.model.nq
        return state[:, -1, 1 : 1 + nq], state[:, -1, 1 + nq :]

    def sensors(self, qpos: Floats, qvel: Floats, control: Floats) -> Floats:
        """Read sensors [n, nsensordata] at these very states: [n, nq], [n, nv], [n, nu]."""
        if len(qpos) == 1:
            data = self._placed(qpos, qvel, control)
            mujoco.mj_forward(self.model, data)
            return np.array(data.sensordata[None])
        # A step reads its sensors before it integrates, so one more step tells those of the state
        # it starts from.
        _, sensordata = self._run(qpos, qvel, control, 1)
        return sensordata[:, 0]

    def _placed(self, qpos: Floats, qvel: Floats, control: Floats) -> mujoco.MjData:
        """The state of a single row: the same numbers as in a batch, without the batch's
        overhead.
        """
        data = self._data[0]
        data.qpos[:] = qpos[0]
        data.qvel[:] = qvel[0]
        data.ctrl[:] = control[0]
        data.qacc_warmstart[:] = 0.0
        data.time = 0.0
        return data

    def _run(
        self, qpos: Floats, qvel: Floats, control: Floats, steps: int
    ) -> tuple[Floats, Floats]:
        """States [n, steps, 1 + nq + nv] and sensors [n, steps, nsensordata] of every step."""
        model = self.model
        rows = len(qpos)
        start = np.concatenate([np.zeros((rows, 1)), qpos, qvel], axis=1)
        held = np.repeat(control[:, None, :], steps, axis=1)
        state = np.empty((rows, steps, start.shape[1]))
        sensordata = np.empty((rows, steps, model.nsensordata))
        if rows:
            self._rollout.rollout(
                [model] * rows,
                self._data,
                start,
                held,
                control_spec=_CONTROL,
                skip_checks=True,
                nstep=steps,
                initial_warmstart=np.zeros((rows, model.nv)),
                state=state,
                sensordata=sensordata,
            )
        return state, sensordata


# numbers in the pose (x, y, z, quaternion) and the velocity of a free body
BODY_POSE = 7
BODY_SPEED = 6

# name of the contact sensor between agent and walls; models with walls have it
STATIC_SENSOR = "touches_static"


def body_sensor(index: int) -> str:
    """Return the name of the contact sensor between the agent and the active body `index`."""
    return f"touches_body{index}"


class ModelBuilder(Protocol):
    """Makes the model of an agent with some free bodies."""

    def __call__(self, bodies: int, walls: int, integrate: bool) -> mujoco.MjModel:
        """The agent's joints come first, then one free joint per body; sensors of the agent first.

        Walls are 0 (none), 1 (all of them), or a task's own number for a part of them. A model that
        is not to integrate only tells sensors and contacts; it may be simpler.
        """
        ...


class State(NamedTuple):
    """Agents and free bodies of n rows."""

    qpos: Floats  # [n, nq] of the agent
    qvel: Floats  # [n, nv] of the agent
    bodies: Floats  # [n, F, 7]
    speeds: Floats  # [n, F, 6]


class Surroundings(NamedTuple):
    """What takes part in the physics of n rows."""

    active: Bools  # [n, F]
    walls: NDArray[np.int64]  # [n] which walls, as a `ModelBuilder` numbers them


class Contacts(NamedTuple):
    """What the agents touch."""

    static: Bools  # [n]
    bodies: Bools  # [n] any free body


class _Size(NamedTuple):
    """Which model, as a `ModelBuilder` takes it."""

    bodies: int
    walls: int
    integrate: bool


class _Group(NamedTuple):
    """Rows that share a model: n' of them, with K active bodies each."""

    rows: NDArray[np.intp]  # [n']
    active: NDArray[np.intp]  # [n', K] indices of the active bodies
    physics: BatchPhysics


class LocalPhysics:
    """Steps rows in groups that share a model; models are built when first needed."""

    def __init__(self, build: ModelBuilder, threads: int = 1) -> None:
        self._build = build
        self._threads = threads
        self._physics: dict[_Size, BatchPhysics] = {}
        model = self._of(0, 0, True).model
        self.nq = int(model.nq)
        self.nv = int(model.nv)
        self.nu = int(model.nu)

    def __reduce__(self) -> tuple[type[LocalPhysics], tuple[ModelBuilder, int]]:
        # MuJoCo's pool of threads cannot be copied, and nothing of a model outlives a call: a copy
        # builds its own.
        return LocalPhysics, (self._build, self._threads)

    def advance(self, state: State, control: Floats, around: Surroundings, steps: int) -> State:
        """Advance states by `steps` physics steps under a held control [n, nu]. Bodies that are
        not active stay as they are.
        """
        after = State(*(array.copy() for array in state))
        for group in self._groups(around, integrate=True):
            rows = group.rows
            start = _packed(state, group)
            qpos, qvel = group.physics.advance(*start, control[rows], steps)
            after.qpos[rows] = qpos[:, : self.nq]
            after.qvel[rows] = qvel[:, : self.nv]
            if group.active.size:
                shape = group.active.shape
                places = (rows[:, None], group.active)
                after.bodies[places] = qpos[:, self.nq :].reshape(*shape, BODY_POSE)
                after.speeds[places] = qvel[:, self.nv :].reshape(*shape, BODY_SPEED)
        return after

    def sensors(self, state: State, control: Floats, around: Surroundings, count: int) -> Floats:
        """Read the first `count` sensor numbers [n, count] at these very states, under a
        control [n, nu].
        """
        out = np.empty((len(state.qpos), count))
        for group in self._groups(around, integrate=False):
            values = group.physics.sensors(*_packed(state, group), control[group.rows])
            out[group.rows] = values[:, :count]
        return out

    def contacts(self, state: State, control: Floats, around: Surroundings) -> Contacts:
        """Tell whether the agents touch walls or bodies in these very states, under a control
        [n, nu].
        """
        static = np.zeros(len(state.qpos), np.bool_)
        bodies = np.zeros(len(state.qpos), np.bool_)
        if not around.walls.any() and not around.active.any():
            return Contacts(static, bodies)
        for group in self._groups(around, integrate=False):
            rows = group.rows
            model = group.physics.model
            count = group.active.shape[1]
            walls = int(around.walls[rows[0]])
            if not count and not walls:
                continue
            values = group.physics.sensors(*_packed(state, group), control[rows])
            if walls:
                static[rows] = values[:, model.sensor(STATIC_SENSOR).adr[0]] > 0
            if count:
                columns = [model.sensor(body_sensor(i)).adr[0] for i in range(count)]
                bodies[rows] = (values[:, columns] > 0).any(axis=1)
        return Contacts(static, bodies)

    def _groups(self, around: Surroundings, integrate: bool) -> Iterator[_Group]:
        """The rows in groups that share a model, by the number of active bodies and the walls."""
        counts = around.active.sum(axis=1)
        # One number for both.
        radix = int(around.walls.max(initial=0)) + 1
        keys = (radix * counts + around.walls).tolist()
        for key in sorted(set(keys)):
            rows = np.array([row for row, own in enumerate(keys) if own == key])
            count, walls = divmod(key, radix)
            active = np.zeros((len(rows), 0), np.intp)
            if count:
                active = np.argsort(~around.active[rows], axis=1, kind="stable")[:, :count]
            yield _Group(rows, active, self._of(count, walls, integrate))

    def _of(self, bodies: int, walls: int, integrate: bool) -> BatchPhysics:
        """The physics of a model, built when it is first asked for."""
        size = _Size(bodies, walls, integrate)
        if size not in self._physics:
            model = self._build(bodies, walls, integrate)
            self._physics[size] = BatchPhysics(model, self._threads)
        return self._physics[size]


def _packed(state: State, group: _Group) -> tuple[Floats, Floats]:
    """qpos [n', nq] and qvel [n', nv] of a group's model: of the agents, then of their active
    bodies.
    """
    rows = group.rows
    if not group.active.size:
        return state.qpos[rows], state.qvel[rows]
    places = (rows[:, None], group.active)
    bodies = state.bodies[places].reshape(len(rows), -1)
    speeds = state.speeds[places].reshape(len(rows), -1)
    qpos = np.concatenate([state.qpos[rows], bodies], axis=1)
    qvel = np.concatenate([state.qvel[rows], speeds], axis=1)
    return qpos, qvel


def active_bodies(
    agent_xy: Floats,
    bodies: Floats,
    speeds: Floats,
    *,
    reach: float | Floats,
    apart: float,
    rest: float,
    max_distance: float = np.inf,
) -> Bools:
    """Choose the free bodies [n, F] that take part: those in the agent's reach, those that move,
    and those in reach of one of these.

    Args:
        agent_xy: [n, 2] in m.
        bodies: [n, F, 7] poses: place in m, then quaternion.
        speeds: [n, F, 6] in m/s and rad/s.
        reach: distance of the agent's origin from a body's within which they can touch during an
            env step, in m; one, or [n, F].
        apart: the same between two bodies, in m.
        rest: largest entry of a velocity that counts as rest, in m/s or rad/s.
        max_distance: a body farther than this from the agent stands still, whatever its velocity,
            in m.
    """
    if not bodies.shape[1]:
        return np.zeros(bodies.shape[:2], np.bool_)
    range_ = distance(bodies[..., :2], agent_xy[:, None])
    moving = (np.abs(speeds) > rest).any(axis=2) & (range_ < max_distance)
    active: Bools = (range_ < reach) | moving
    if active.any():
        row, first = np.nonzero(active)
        close = distance(bodies[row, :, :2], bodies[row, first, None, :2]) < apart
        np.logical_or.at(active, row, close)
    return active
