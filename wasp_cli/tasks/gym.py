"""The tasks as standard gymnasium environments: `gymnasium.make("wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0")`.

Importing this module registers every task under the namespace `wasp/`; MuJoCo is imported when one is made.
The cost comes as `info["cost"]`, as in the 5-tuple environments of the reference package. `gymnasium.make_vec` steps B episodes in one
call (`TaskVectorEnv`); `upstream` and the option `upstream_api=True` give the reference package's own six-tuple.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, SupportsFloat, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks import reference
from wasp_cli.tasks.base import MAP_SIZE, Pixels
from wasp_cli.tasks.gym_common import (
    Info,
    Maps,
    ObservationName,
    Seen,
    checked_control,
    chosen_fields,
    drawn_layout,
    limited_spec,
    observed_task,
    refuse_other_task,
    refuse_reset_options,
    refuse_unknown,
    row_of,
    space_of,
)
from wasp_cli.tasks.registry import TASKS

_OPTIONS = ("observation", "action_repeat", "render_mode", "width", "height", "upstream_api")


class TaskEnv(gymnasium.Env[Any, NDArray[Any]]):
    """One episode of a task.

    Args:
        task: a name of `wasp_cli.tasks.registry.TASKS`.
        observation: `state` (float64 [S], the reference package's vector), `pixels` (uint8 [6, 64, 64]), `privileged` (float32 [P]),
            `all` (a dictionary of these three), or `vision` (a dictionary as that of the reference package's Vision ids: its sensors by
            name, and as `vision` the front image, uint8 [64, 64, 3]).
        action_repeat: env steps per `step`; rewards and costs add up.
        render_mode: `rgb_array` gives pictures for people: a map from above, uint8 [height, width, 3].
        width: of the map in pixels.
        height: the same: maps are square.
        upstream_api: `step` returns the reference package's six values (obs, reward, cost, terminated, truncated, info), with its keys in
            `info`: `cost_<source>` and `cost_sum` in every step, `goal_met` in those that reach a goal. Wrappers of gymnasium expect five
            values and fail on it, so nothing but what `gymnasium.make` adds here by itself may lie around it (no `max_episode_steps=`).
        registered: the task of the gymnasium id that is made, which `task` may not replace. Not for callers.

    `info` of a step, and with zeros of a reset: `cost` (env steps that cost, 0 or 1 without action repeat; `cost_sum` is the same),
    `cost_<source>` (the same per source), `goals` (reached in this episode so far), `success` (whether they are as many as the task asks
    for). Actions beyond the bounds of the action space are clipped to them, as the reference package does.

    A copy (`copy.deepcopy`, pickle) goes on bit for bit, in another process too.

    Raises:
        UnknownName: no such task.
        UnknownOption: an unknown option, which is a `TypeError` too.
        UsageError: an unknown observation or render mode.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

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
        refuse_unknown("TaskEnv", task, unknown, _OPTIONS)
        self._task, self._name = observed_task(task, 1, observation, action_repeat), observation
        self._success_goals = TASKS[task].success_goals
        self._upstream = bool(upstream_api)
        self._spec: EnvSpec | None = None
        self._goals = 0
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._task.decision_seconds)}
        self.render_mode, self._maps = render_mode, Maps(task, self._task, render_mode, width, height)
        self.action_space = gymnasium.spaces.Box(self._task.action_low, self._task.action_high, dtype=np.float64)
        self.observation_space = space_of(self._task, observation)

    @property
    def max_episode_steps(self) -> int:
        """Steps after which every episode has ended: the tasks keep their own time limit."""
        return self._task.max_decisions

    @property
    def spec(self) -> EnvSpec | None:  # gymnasium sets it after making the environment
        """What `gymnasium.make` makes such an environment of, the time limit included; None for one that was made without it."""
        if self._spec is None:
            return None
        spec = limited_spec(self._spec, self.max_episode_steps)
        if not self._upstream:
            return spec
        # Whoever makes this spec puts a TimeLimit around, which works on five values: six come last, and without it.
        options = {name: value for name, value in spec.kwargs.items() if name != "upstream_api"}
        six = WrapperSpec("give_six_values", f"{__name__}:give_six_values", {})
        return replace(spec, kwargs=options, additional_wrappers=(*spec.additional_wrappers, six))

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Keep what gymnasium sets; the time limit is added when it is read."""
        self._spec = spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Start an episode. A seed below 2^32 names a layout, the same as in the reference package; without one a new layout is drawn.

        Larger seeds, as Minari draws them, seed the draw of a layout.

        Raises:
            UsageError: `options` holds something; there are none.
        """
        super().reset(seed=seed, options=options)
        refuse_reset_options(options)
        layout = drawn_layout(self.np_random, seed)
        self._goals = 0
        seen = row_of(chosen_fields(self._task, self._task.reset([layout]), self._name), 0)
        return seen, self._told(Info.zeros(self._task), 0)

    def step(self, action: NDArray[Any]) -> tuple[Seen, SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by `action_repeat` env steps under `action` [A].

        Raises:
            TaskError: the action is no finite [A], or the episode has not begun or has ended.
        """
        step = self._task.step(checked_control(action, (self._task.action_size,))[None])
        reached = int(step.goals[0])
        self._goals += reached
        terminated = bool(step.terminated[0])
        seen = row_of(chosen_fields(self._task, step.observation, self._name), 0)
        reward, truncated = float(step.reward[0]), bool(step.ended[0]) and not terminated
        goals = np.array([self._goals])
        told = Info.of(step, goals, goals >= self._success_goals)
        if self._upstream:
            six = (seen, reward, float(told.cost[0]), terminated, truncated, self._told(told, reached))
            return cast("tuple[Seen, float, bool, bool, dict[str, Any]]", six)
        return seen, reward, terminated, truncated, self._told(told, reached)

    def _told(self, info: Info, reached: int) -> dict[str, Any]:
        """What `info` says; in the reference package's keys where its six values are given."""
        if not self._upstream:
            return info.row(0)
        costs = {f"cost_{name}": float(value[0]) for name, value in info.sources.items()} | {"cost_sum": float(info.cost[0])}
        return costs | {"goal_met": True} if reached else costs

    def render(self) -> Pixels | None:
        """Draw the episode as a map from above, uint8 [height, width, 3]; None without a render mode."""
        return self._maps.draw(0)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return everything that determines the rest of this episode, as plain arrays; `restore` of it is exact to the bit.

        Which layouts later resets without a seed draw is not part of it (a copy of the environment keeps that too).

        Raises:
            TaskError: no episode has begun.
        """
        return {**self._task.snapshot(), "goals_reached": np.array([self._goals])}

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Seen:
        """Return to a snapshot of an environment with the same task and options, and see what was seen there.

        Raises:
            TaskError: it is no snapshot of such an environment.
        """
        if "goals_reached" not in snapshot:
            raise TaskError("the snapshot is not one of an environment: 'goals_reached' is missing")
        seen = self._task.restore({name: array for name, array in snapshot.items() if name != "goals_reached"})
        self._goals = int(snapshot["goals_reached"][0])
        return row_of(chosen_fields(self._task, seen, self._name), 0)


def give_six_values(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Let an environment that was made with five values give the reference package's six, and take off the TimeLimit, which unpacks five.

    `gymnasium.make(env.spec)` calls it for the spec of an environment with `upstream_api=True`.
    """
    while isinstance(env, gymnasium.wrappers.TimeLimit):
        env = env.env
    made = env.unwrapped
    assert isinstance(made, TaskEnv)
    made._upstream = True
    return env


def upstream(id: str, **options: Any) -> gymnasium.Env[Any, NDArray[Any]]:
    """Make a task under the reference package's interface: stands for `safety_gymnasium.make(id)` in code that is to be ported.

    Args:
        id: `SafetyPointGoal1-v0`, with or without `wasp/`, or a name such as `goal1`. `...Vision-v0` is the same with
            `observation="vision"`, `...Gymnasium-v0` the same with gymnasium's five values.
        options: of `TaskEnv`; `width` and `height` among them.

    Raises:
        UnknownName: no such task.
        UnknownOption: an option that neither has, or that only the reference package has (`wasp_cli.tasks.reference.MISSING`).
    """
    known = reference.parse_id(id)
    reference.refuse_missing(known, options)
    vision: dict[str, Any] = {"observation": "vision"} if known.vision else {}
    return gymnasium.make(TASKS[known.task].gym_id, **{"upstream_api": not known.five_values, **vision, **options})


def register_envs() -> None:
    """Register every task that is not registered yet."""
    for name in TASKS:
        info = TASKS[name]
        if info.gym_id not in gymnasium.registry:
            # The tasks keep their own time limit, which is why no TimeLimit wrapper is asked for; and they check actions themselves, while
            # gymnasium's checker would refuse the six-tuple.
            gymnasium.register(
                id=info.gym_id,
                entry_point="wasp_cli.tasks.gym:TaskEnv",
                vector_entry_point="wasp_cli.tasks.gym_vector:TaskVectorEnv",
                disable_env_checker=True,
                kwargs={"task": name, "registered": name},
            )


register_envs()
