"""One episode of a task as a gymnasium environment."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, SupportsFloat, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UsageError
from wasp_cli.tasks.base import MAP_SIZE, Observation, Pixels, Step, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.gym.arguments import (
    checked_control,
    drawn_layout,
    refuse_other_task,
    refuse_unknown,
)
from wasp_cli.tasks.gym.observing import ObservationName, Seen, observed_task, shown, space_of
from wasp_cli.tasks.registry import TASKS

OPTIONS = ("observation", "action_repeat", "render_mode", "width", "height", "upstream_api")


class TaskEnv(gymnasium.Env[Any, NDArray[Any]]):
    """One episode of a task, a name of `wasp_cli.tasks.registry.TASKS`; docs/tasks.md has the
    options and the keys of `info`.

    Observations are `state` (float64 [S], the reference package's vector), `pixels` (uint8 [6, 64,
    64]), `privileged` (float32 [P]), `all` (a dictionary of these three) or `vision` (a dictionary:
    the reference package's sensors by name, and its image [64, 64, 3]). With `upstream_api` a step
    returns the reference package's six values (obs, reward, cost, terminated, truncated, info), on
    which gymnasium's wrappers fail. `registered` is the task of the gymnasium id that is made,
    which `task` may not replace; not for callers.

    A copy (`copy.deepcopy`, pickle) goes on bit for bit, in another process too.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}
    _row = 0  # of the task's batch

    def __init__(
        self,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        render_mode: Literal["rgb_array"] | None = None,
        width: int = MAP_SIZE,
        height: int = MAP_SIZE,
        upstream_api: bool = False,
        registered: str | None = None,
        **unknown: object,
    ) -> None:
        refuse_other_task(task, registered)
        refuse_unknown("TaskEnv", task, unknown, OPTIONS)
        self._task = self._made(task, observation, action_repeat)
        self._observation = observation
        if render_mode is not None and (
            render_mode != "rgb_array" or not isinstance(self._task, HasScene)
        ):
            raise UsageError(
                f"task '{task}' cannot render '{render_mode}'", "render_mode is None or 'rgb_array'"
            )
        if width != height or not isinstance(width, int | np.integer) or width < 1:
            raise UsageError(
                f"a map is square, and not {width!r} x {height!r} pixels",
                "give width and height the same number",
            )
        self.task_name = task
        self._success_goals = TASKS[task].success_goals
        self._upstream = bool(upstream_api)
        self._spec: EnvSpec | None = None
        self._goals = 0
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._task.decision_seconds)}
        self.render_mode = render_mode
        self._map_size = int(width)
        self.action_space = gymnasium.spaces.Box(
            self._task.action_low, self._task.action_high, dtype=np.float64
        )
        self.observation_space = space_of(self._task, observation)

    def _made(self, task: str, observation: str, action_repeat: int) -> VectorTask:
        return observed_task(task, 1, observation, action_repeat)

    @property
    def action_repeat(self) -> int:
        """Env steps of a step."""
        return self._task.action_repeat

    @property
    def max_episode_steps(self) -> int:
        """Steps after which every episode has ended."""
        return self._task.max_decisions

    @property
    def spec(self) -> EnvSpec | None:  # gymnasium sets it after making the environment
        """Return the registration, with the task's own time limit where it has none."""
        if self._spec is None:
            return None
        return replace(
            self._spec, max_episode_steps=self._spec.max_episode_steps or self.max_episode_steps
        )

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Keep the registration with which gymnasium has made this environment."""
        self._spec = spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        """Start an episode. A seed below 2^32 names a layout, the same as in the reference package;
        without one a new layout is drawn.

        Larger seeds, as Minari draws them, seed the draw of a layout.
        """
        super().reset(seed=seed, options=options)
        for option in options or {}:
            raise UsageError(
                f"reset has no option '{option}'",
                "a seed names a layout; there is nothing else to choose",
            )
        self._goals = 0
        rows = np.arange(self._task.batch) == self._row
        layout = drawn_layout(self.np_random, seed)
        observation = self._task.reset([layout], rows)
        return self._seen(observation), self._info(None)

    def step(self, action: NDArray[Any]) -> tuple[Seen, SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by `action_repeat` env steps under `action` [A].

        Raises:
            TaskError: the action is no array [A] of finite numbers, or the episode has ended.
        """
        step = self._advance(action)
        row = self._row
        self._goals += int(step.goals[row])
        seen = self._seen(step.observation)
        info = self._info(step)
        reward = float(step.reward[row])
        terminated = bool(step.terminated[row])
        truncated = bool(step.ended[row]) and not terminated
        if self._upstream:
            six = (seen, reward, float(step.cost_env[row]), terminated, truncated, info)
            return cast("tuple[Seen, float, bool, bool, dict[str, Any]]", six)
        return seen, reward, terminated, truncated, info

    def _advance(self, action: NDArray[Any]) -> Step:
        return self._task.step(checked_control(action, (self._task.action_size,))[None])

    def _seen(self, observation: Observation) -> Seen:
        return shown(self._task, observation, self._row, self._observation)

    def _info(self, step: Step | None) -> dict[str, Any]:
        """The info of a step, or of a reset (None); with the reference package's keys where its six
        values are returned.

        All values are NumPy's, as TorchRL's reader wants them.
        """
        cost = np.float64(0.0)
        sources = {f"cost_{name}": np.float64(0.0) for name in self._task.cost_sources}
        if step is not None:
            cost = np.float64(step.cost_env[self._row])
            for name in self._task.cost_sources:
                sources[f"cost_{name}"] = np.float64(step.sources[name][self._row])
        if self._upstream:
            upstream_info = {**sources, "cost_sum": cost}
            if step is not None and step.goals[self._row]:
                return {**upstream_info, "goal_met": True}
            return upstream_info
        # An array of no axes: of NumPy's bools gymnasium's vectors would make objects.
        success = np.array(self._goals >= self._success_goals)
        return {
            "cost": cost,
            "cost_sum": cost,
            **sources,
            "goals": np.int64(self._goals),
            "success": success,
        }

    def render(self) -> Pixels | None:
        """Draw the episode as a map from above, uint8 [height, width, 3]; None without a render
        mode.
        """
        if self.render_mode is None:
            return None
        # Not above: it imports MuJoCo, which is not needed before a task is made.
        from wasp_cli.tasks.camera.topdown import from_above

        assert isinstance(self._task, HasScene)
        return from_above(self._task, self._row, self._map_size)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return everything that determines the rest of this episode, as plain arrays; `restore` of
        it is exact to the bit.

        Which layouts later resets without a seed draw is not part of it (a copy of the environment
        keeps that too).
        """
        row = slice(self._row, self._row + 1)
        arrays = {name: array[row] for name, array in self._task.snapshot().items()}
        return {**arrays, "goals_reached": np.array([self._goals])}

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Seen:
        """Return to a snapshot of an environment with the same task and options, and return the
        observation that it had there. Raises TaskError where it is no such snapshot.
        """
        if "goals_reached" not in snapshot:
            raise TaskError("the snapshot is not one of an environment: 'goals_reached' is missing")
        observation = self._task.restore(
            {name: array for name, array in snapshot.items() if name != "goals_reached"}
        )
        self._goals = int(snapshot["goals_reached"][0])
        return self._seen(observation)
