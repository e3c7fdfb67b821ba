"""The tasks as standard gymnasium environments: `gymnasium.make("wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0")`.

Importing this module registers every task under the namespace `wasp/`; MuJoCo is imported when one is made.
The cost comes as `info["cost"]`, as in the 5-tuple environments of the reference package. `gymnasium.make_vec` steps B episodes in one
call (`TaskVectorEnv`); `upstream` and the option `upstream_api=True` give the reference package's own six-tuple.
"""

from __future__ import annotations

from typing import Any, Literal, SupportsFloat, cast, get_args

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UnknownName, UsageError, did_you_mean
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, Observation, Pixels, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS, task_named

ObservationName = Literal["state", "pixels", "privileged", "all"]
Seen = NDArray[Any] | dict[str, NDArray[Any]]
"""An observation: an array, or with `all` a dictionary of three."""


def observed_task(task: str, batch: int, observation: str, action_repeat: int, threads: int = 1) -> VectorTask:
    """Make a batch of a task that shows the asked observation.

    Raises:
        UnknownName: no such task.
        UsageError: an unknown observation, or a number below 1.
    """
    if observation not in (known := get_args(ObservationName)):
        raise UsageError(f"task '{task}' has no observation '{observation}'", did_you_mean(str(observation), known))
    for option, value in (("num_envs", batch), ("action_repeat", action_repeat), ("threads", threads)):
        if not isinstance(value, int | np.integer) or value < 1:
            raise UsageError(f"{option} should be an integer of at least 1, not {value!r}")
    observe = Observation._fields if observation == "all" else (observation,)
    return make_task(task, batch, action_repeat=action_repeat, observe=observe, threads=threads)


def drawn_task(task: str, made: VectorTask, mode: str | None) -> HasScene | None:
    """Return the task that a render mode draws; None without one.

    Raises:
        UsageError: a mode that the task does not have.
    """
    if mode is None:
        return None
    if mode != "rgb_array" or not isinstance(made, HasScene):
        raise UsageError(f"task '{task}' cannot render '{mode}'", "render_mode is None or 'rgb_array'")
    return made


def map_of(task: HasScene, row: int) -> Pixels:
    """Draw one episode as a map from above: uint8 [256, 256, 3]."""
    # Not above: it imports MuJoCo, and a registered task does not need it before it is made.
    from wasp_cli.tasks.camera.topdown import from_above

    return from_above(task, row)


def refuse_other_task(task: str, registered: str | None) -> None:
    """Refuse another task under an id that stands for one: results under its name must not be those of another."""
    if registered is not None and task != registered:
        hint = f"that is gymnasium.make('{TASKS[task].gym_id}')" if task in TASKS else "leave task= out"
        raise UsageError(f"'{TASKS[registered].gym_id}' is the task '{registered}', and task={task!r} cannot change it", hint)


def refuse_unknown(task: str, unknown: dict[str, object], known: tuple[str, ...]) -> None:
    """Name an option that a task does not have, and what was meant.

    Raises:
        UsageError: there is one.
    """
    for option in unknown:
        raise UsageError(f"task '{task}' has no option '{option}'", did_you_mean(option, known))


def refuse_reset_options(options: dict[str, Any] | None) -> None:
    """Refuse options of a reset: nothing about it can be chosen.

    Raises:
        UsageError: there is an option.
    """
    for option in options or {}:
        raise UsageError(f"reset has no option '{option}'", "a seed names a layout; there is nothing else to choose")


def space_of(task: VectorTask, observation: str) -> gymnasium.Space[Any]:
    """Return the space of one episode's observation."""
    spaces: dict[str, gymnasium.Space[Any]] = {
        "state": gymnasium.spaces.Box(-np.inf, np.inf, (task.state_size,), np.float64),
        "pixels": gymnasium.spaces.Box(0, 255, (6, CAMERA_SIZE, CAMERA_SIZE), np.uint8),
        "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (task.privileged_size,), np.float32),
    }
    return gymnasium.spaces.Dict(spaces) if observation == "all" else spaces[observation]


def chosen_fields(observation: Observation, name: str) -> Seen:
    """Return what was asked for of an observation, [B, ...]."""
    fields: dict[str, NDArray[Any]] = {field: value for field, value in observation._asdict().items() if value is not None}
    return fields if name == "all" else fields[name]


def first_row(seen: Seen) -> Seen:
    """Return the observation of the first episode of a batch."""
    return {name: value[0] for name, value in seen.items()} if isinstance(seen, dict) else seen[0]


def checked_control(action: Any, shape: tuple[int, ...]) -> Floats:
    """Return an action as float64 of a shape.

    Raises:
        TaskError: it is no array of finite real numbers of that shape.
    """
    try:
        given = np.asarray(action)
        # NumPy would drop imaginary parts, and read texts of digits.
        if given.dtype.kind not in "biufO":
            raise TypeError(given.dtype)
        control = given.astype(np.float64)
    except (TypeError, ValueError) as error:
        kind = f"{type(action).__name__} of {action.dtype}" if isinstance(action, np.ndarray) else type(action).__name__
        raise TaskError(f"an action is an array of real numbers, not {kind}") from error
    if control.shape != shape:
        raise TaskError(f"action has shape {control.shape}, expected {shape}")
    if not np.isfinite(control).all():
        raise TaskError(f"action is not finite: {control.tolist()}")
    return control


class TaskEnv(gymnasium.Env[Any, NDArray[Any]]):
    """One episode of a task.

    Args:
        task: a name of `wasp_cli.tasks.registry.TASKS`.
        observation: `state` (float64 [S], the reference package's vector), `pixels` (uint8 [6, 64, 64]), `privileged` (float32 [P]), or
            `all` (a dictionary of these three).
        action_repeat: env steps per `step`; rewards and costs add up.
        render_mode: `rgb_array` gives pictures for people: a map from above, uint8 [256, 256, 3].
        upstream_api: `step` returns the reference package's six values (obs, reward, cost, terminated, truncated, info), with its keys in
            `info`: `cost_<source>` and `cost_sum` in every step, `goal_met` in those that reach a goal. Wrappers of gymnasium expect five
            values and fail on it, so nothing but what `gymnasium.make` adds here by itself may lie around it (no `max_episode_steps=`).
        registered: the task of the gymnasium id that is made, which `task` may not replace. Not for callers.

    `info` of a step: `cost` (env steps that cost, 0 or 1 without action repeat), `cost_sources` (the same per source), `goals` (reached
    in this episode so far), `success` (whether they are as many as the task asks for). Actions beyond the bounds of the action space are
    clipped to them, as the reference package does.

    Raises:
        UnknownName: no such task.
        UsageError: an unknown option, observation or render mode.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        render_mode: Literal["rgb_array"] | None = None,
        upstream_api: bool = False,
        registered: str | None = None,
        **unknown: object,
    ) -> None:
        refuse_other_task(task, registered)
        refuse_unknown(task, unknown, ("observation", "action_repeat", "render_mode", "upstream_api"))
        self._task, self._name = observed_task(task, 1, observation, action_repeat), observation
        self._success_goals = TASKS[task].success_goals
        self._upstream = bool(upstream_api)
        self._goals = 0
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._task.decision_seconds)}
        self.render_mode, self._drawn = render_mode, drawn_task(task, self._task, render_mode)
        self.action_space = gymnasium.spaces.Box(self._task.action_low, self._task.action_high, dtype=np.float64)
        self.observation_space = space_of(self._task, observation)

    @property
    def max_episode_steps(self) -> int:
        """Steps after which every episode has ended: the tasks keep their own time limit."""
        return self._task.max_decisions

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Start an episode. A seed names a layout, the same as in the reference package; without one a new layout is drawn.

        Raises:
            UsageError: `options` holds something; there are none.
            TaskError: the seed is beyond the range of the layouts.
        """
        super().reset(seed=seed, options=options)
        refuse_reset_options(options)
        layout = int(self.np_random.integers(SEED_LIMIT)) if seed is None else seed
        self._goals = 0
        return first_row(chosen_fields(self._task.reset([layout]), self._name)), {}

    def step(self, action: NDArray[Any]) -> tuple[Seen, SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by `action_repeat` env steps under `action` [A].

        Raises:
            TaskError: the action is no finite [A], or the episode has not begun or has ended.
        """
        step = self._task.step(checked_control(action, (self._task.action_size,))[None])
        reached = int(step.goals[0])
        self._goals += reached
        terminated = bool(step.terminated[0])
        seen, reward, truncated = first_row(chosen_fields(step.observation, self._name)), float(step.reward[0]), bool(step.ended[0])
        cost, sources = float(step.cost_env[0]), {name: float(count[0]) for name, count in step.sources.items()}
        truncated = truncated and not terminated
        if self._upstream:
            upstream_info: dict[str, Any] = {f"cost_{name}": value for name, value in sources.items()} | {"cost_sum": cost}
            if reached:
                upstream_info["goal_met"] = True
            six = (seen, reward, cost, terminated, truncated, upstream_info)
            return cast("tuple[Seen, float, bool, bool, dict[str, Any]]", six)
        success = self._goals >= self._success_goals
        return seen, reward, terminated, truncated, {"cost": cost, "cost_sources": sources, "goals": self._goals, "success": success}

    def render(self) -> Pixels | None:
        """Draw the episode as a map from above, uint8 [256, 256, 3]; None without a render mode."""
        return None if self._drawn is None else map_of(self._drawn, 0)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return everything that determines the rest of this episode, as plain arrays; `restore` of it is exact to the bit.

        Which layouts later resets without a seed draw is not part of it.
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
        return first_row(chosen_fields(seen, self._name))


def upstream(task: str, **options: Any) -> gymnasium.Env[Any, NDArray[Any]]:
    """Make a task under the reference package's interface: stands for `safety_gymnasium.make(task)` in code that is to be ported.

    Args:
        task: `SafetyPointGoal1-v0`, with or without `wasp/`, or a name such as `goal1`.
        options: of `TaskEnv`.

    Raises:
        UnknownName: no such task.
    """
    name = task_named(task)
    if name not in TASKS:  # somebody else's gymnasium id
        raise UnknownName("task", task, [*TASKS, *(TASKS[known].gym_id for known in TASKS)])
    return gymnasium.make(TASKS[name].gym_id, upstream_api=True, **options)


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
