"""SafetyPointGoal1: a point robot collects goals among eight hazards, for a batch of B episodes.

An env step is 10 physics steps under a held action, then reward, cost, the move of a reached goal, and the time limit, in this order.
A decision step is `action_repeat` env steps. Physics knows neither goals nor hazards, and every env step is a pure function of its
row's own state: results do not depend on the batch size, the other rows, the number of threads, or how decision steps cut the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks import goal1_model as g1
from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats, Observation, Pixels, Step
from wasp_cli.tasks.camera import Camera, Scene
from wasp_cli.tasks.goal1_features import PRIVILEGED_SIZE, STATE_SIZE, privileged_vector, state_vector
from wasp_cli.tasks.layout import Streams, Thing, checked_seed, draw_goal, draw_layout
from wasp_cli.tasks.physics import BatchPhysics
from wasp_cli.tasks.topdown import draw_map

ENV_SECONDS = g1.TIMESTEP * g1.PHYSICS_STEPS
NUM_STEPS = 1000
"""Time limit in env steps; nothing else ends an episode, but a goal that finds no free place."""
REWARD_GOAL, REWARD_CLIP = 1.0, 10.0

AGENT = Thing("agent", keepout=0.4)
GOAL = Thing("goal", keepout=0.305)
HAZARDS = tuple(Thing(f"hazard{i}", keepout=0.18) for i in range(g1.HAZARDS))
VASE = Thing("vase", keepout=0.15)

# The agent's arrow and the corner of a tipped vase reach 0.16 and 0.18 m; within an env step at most 0.03 m are driven.
_VASE_REACH = 0.4
_VASE_REST = 1e-12


@dataclass
class _Totals:
    """Sums over one decision step, one entry per row."""

    reward: Floats
    cost: NDArray[np.int64]
    goals: NDArray[np.int64]
    env_steps: NDArray[np.int64]


class Goal1:
    """The task `goal1` as a `VectorTask`; see there for the meaning of every member."""

    action_size = 2
    privileged_size = PRIVILEGED_SIZE
    state_size = STATE_SIZE
    cost_sources = ("hazards",)

    def __init__(
        self,
        batch: int,
        *,
        action_repeat: int = 4,
        observe: Sequence[str] = ("pixels", "state", "privileged"),
        threads: int = 1,
    ) -> None:
        if batch < 1 or action_repeat < 1 or threads < 1:
            raise TaskError(f"batch {batch}, action_repeat {action_repeat} and threads {threads} must be at least 1")
        unknown = sorted(set(observe) - set(Observation._fields))
        if unknown:
            raise TaskError(f"no such observation: {', '.join(unknown)}", f"known: {', '.join(Observation._fields)}")
        self.batch = batch
        self.action_repeat = action_repeat
        self.observe = tuple(observe)
        self.action_low, self.action_high = np.full(2, -1.0), np.full(2, 1.0)
        self.decision_seconds = ENV_SECONDS * action_repeat
        self.max_decisions = -(-NUM_STEPS // action_repeat)

        model = g1.full_model()
        self._physics = BatchPhysics(model, threads)
        self._lone_physics = BatchPhysics(g1.lone_agent_model(), threads)
        self._camera = Camera(model, threads) if "pixels" in self.observe else None

        self._qpos = np.tile(model.qpos0, (batch, 1))
        self._qvel = np.zeros((batch, model.nv))
        self._control = np.zeros((batch, 2))
        self._velocity = np.zeros((batch, 2))
        self._turn = np.zeros(batch)
        self._hazards = np.zeros((batch, g1.HAZARDS, 2))
        self._goal = np.zeros((batch, 2))
        self._env_steps = np.zeros(batch, np.int64)
        self._ended = np.ones(batch, np.bool_)
        self._terminated = np.zeros(batch, np.bool_)
        self._streams = Streams(batch)
        self._pixels: Pixels = np.zeros((batch, 6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)

    # -- episodes ---------------------------------------------------------------------------------------------------------------

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        if rows is not None and np.shape(rows) != (self.batch,):
            raise TaskError(f"rows has shape {np.shape(rows)}, expected ({self.batch},)")
        chosen = np.arange(self.batch) if rows is None else np.flatnonzero(rows)
        if len(seeds) != len(chosen):
            raise TaskError(f"got {len(seeds)} seeds for {len(chosen)} rows")
        checked = [checked_seed(seed) for seed in seeds]
        for row, seed in zip(chosen.tolist(), checked, strict=True):
            self._start(row, seed)
        return self._observe(chosen)

    def _start(self, row: int, seed: int) -> None:
        layout = draw_layout(self._streams.start(row, seed), AGENT, GOAL, (*HAZARDS, VASE))
        vase_yaw = layout.others_yaw[-1]
        self._qpos[row, :2], self._qpos[row, 2] = layout.agent_xy, layout.agent_yaw
        self._qpos[row, 3:5], self._qpos[row, 5] = layout.others_xy[-1], g1.VASE_Z
        self._qpos[row, 6:] = np.cos(vase_yaw / 2), 0.0, 0.0, np.sin(vase_yaw / 2)
        self._hazards[row] = layout.others_xy[:-1]
        self._goal[row] = layout.goal_xy
        for zeroed in (self._qvel, self._control, self._velocity, self._turn, self._env_steps, self._ended, self._terminated):
            zeroed[row] = 0

    def step(self, action: NDArray[Any]) -> Step:
        control = self._checked(action)
        alive = ~self._ended
        if not alive.any():
            raise TaskError("step after the end: every episode of the batch has ended; call reset first")
        rows = np.flatnonzero(alive)
        self._control[rows] = control[rows]
        yaw = self._qpos[:, 2].copy()
        integers = np.zeros((3, self.batch), np.int64)
        totals = _Totals(np.zeros(self.batch), *integers)
        for _ in range(self.action_repeat):
            running = np.flatnonzero(~self._ended)
            if running.size:
                self._env_step(running, totals)
        self._turn[rows] = (self._qpos[rows, 2] - yaw[rows]) / (totals.env_steps[rows] * ENV_SECONDS)
        return Step(
            observation=self._observe(rows),
            reward=totals.reward,
            cost=totals.cost > 0,
            cost_env=totals.cost,
            sources={"hazards": totals.cost.copy()},
            goals=totals.goals,
            env_steps=totals.env_steps,
            ended=self._ended.copy(),
            terminated=self._terminated.copy(),
        )

    def _checked(self, action: NDArray[Any]) -> Floats:
        control = np.asarray(action, np.float64)
        if control.shape != (self.batch, self.action_size):
            raise TaskError(f"action has shape {control.shape}, expected ({self.batch}, {self.action_size})")
        finite = np.isfinite(control).all(axis=1)
        if not finite.all():
            raise TaskError(f"action of row {int(np.argmin(finite))} is not finite: {control[np.argmin(finite)].tolist()}")
        return np.clip(control, self.action_low, self.action_high)

    def _env_step(self, rows: NDArray[np.intp], totals: _Totals) -> None:
        before = _distance(self._qpos[rows, :2], self._goal[rows])
        moved_from = self._qpos[rows, :2]
        self._advance(rows)
        xy = self._qpos[rows, :2]
        self._velocity[rows] = (xy - moved_from) / ENV_SECONDS
        self._streams.pass_step(rows)
        self._env_steps[rows] += 1

        after = _distance(xy, self._goal[rows])
        reached = after <= g1.GOAL_RADIUS
        reward = before - after + REWARD_GOAL * reached
        totals.reward[rows] += np.clip(reward, -REWARD_CLIP, REWARD_CLIP)
        totals.cost[rows] += (_distance(xy[:, None, :], self._hazards[rows]) < g1.HAZARD_RADIUS).any(axis=1)
        totals.goals[rows] += reached
        totals.env_steps[rows] += 1
        for row in rows[reached].tolist():
            self._move_goal(row)
        self._ended[rows] |= self._env_steps[rows] >= NUM_STEPS

    def _advance(self, rows: NDArray[np.intp]) -> None:
        """One env step of physics. A vase at rest and out of reach stays where it is, which spares most of the time.

        A fresh vase has no speed yet, but falls by a few micrometres before it rests.
        """
        qpos, qvel, control = self._qpos[rows], self._qvel[rows], self._control[rows]
        apart = _distance(qpos[:, :2], qpos[:, 3:5]) > _VASE_REACH
        alone = apart & (self._env_steps[rows] > 0) & (np.abs(qvel[:, 3:]) < _VASE_REST).all(axis=1)
        lone, both = rows[alone], rows[~alone]
        if lone.size:
            self._qpos[lone, :3], self._qvel[lone, :3] = self._lone_physics.advance(
                qpos[alone, :3], qvel[alone, :3], control[alone], g1.PHYSICS_STEPS
            )
        if both.size:
            self._qpos[both], self._qvel[both] = self._physics.advance(qpos[~alone], qvel[~alone], control[~alone], g1.PHYSICS_STEPS)

    def _move_goal(self, row: int) -> None:
        """Draw a new goal clear of where agent, hazards and vase are now."""
        others = np.concatenate([self._qpos[row, None, :2], self._hazards[row], self._qpos[row, None, 3:5]])
        goal = draw_goal(self._streams.catch_up(row), GOAL, (AGENT, *HAZARDS, VASE), others)
        if goal is None:
            self._ended[row] = self._terminated[row] = True
        else:
            self._goal[row] = goal

    # -- observation ------------------------------------------------------------------------------------------------------------

    def _observe(self, changed: NDArray[np.intp]) -> Observation:
        pixels = state = privileged = None
        if self._camera is not None:
            self._pixels[changed] = self._camera.render(self._scene(changed))
            pixels = self._pixels.copy()
        if "state" in self.observe:
            sensors = self._physics.sensors(self._qpos, self._qvel, self._control)
            state = state_vector(sensors, self._qpos, self._goal, self._hazards)
        if "privileged" in self.observe:
            privileged = privileged_vector(self._velocity, self._turn, self._qpos, self._goal, self._hazards)
        return Observation(pixels, state, privileged)

    def _scene(self, rows: NDArray[np.intp]) -> Scene:
        qpos = self._qpos[rows]
        return Scene(qpos[:, :2], qpos[:, 2], self._goal[rows], self._hazards[rows], qpos[:, 3:])

    def topdown(self, row: int, size: int = 256) -> Pixels:
        return draw_map(self._scene(np.array([row])), 0, size)

    # -- snapshot ---------------------------------------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {
            "qpos": self._qpos,
            "qvel": self._qvel,
            "control": self._control,
            "velocity": self._velocity,
            "turn": self._turn,
            "hazards": self._hazards,
            "goal": self._goal,
            "env_steps": self._env_steps,
            "ended": self._ended,
            "terminated": self._terminated,
        }

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return {name: array.copy() for name, array in self._arrays().items()} | self._streams.snapshot()

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Observation:
        for name, array in self.snapshot().items():
            if name not in snapshot or snapshot[name].shape != array.shape:
                raise TaskError(f"the snapshot is not one of goal1 with batch {self.batch}: '{name}' is missing or has another shape")
        for name, array in self._arrays().items():
            array[...] = snapshot[name]
        self._streams.restore(snapshot["stream_key"], snapshot["stream_position"], snapshot["stream_owed"])
        return self._observe(np.arange(self.batch))


def _distance(a: Floats, b: Floats) -> Floats:
    dx, dy = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    distance: Floats = np.sqrt(dx * dx + dy * dy)
    return distance
