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
from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats, HasScene, Observation, Pixels, VectorTask
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS, task_named
from wasp_cli.tasks.views import Viewer, ViewName

ObservationName = Literal["state", "pixels", "privileged", "all"]
Seen = NDArray[Any] | dict[str, NDArray[Any]]
"""An observation: an array, or with `all` a dictionary of three."""


class TaskEnv(gymnasium.Env[Any, NDArray[Any]]):
    """One episode of a task.

    Args:
        task: a name of `wasp_cli.tasks.registry.TASKS`.
        observation: `state` (float64 [S], the reference package's vector), `pixels` (uint8 [6, 64, 64]), `privileged` (float32 [P]), or
            `all` (a dictionary of these three).
        action_repeat: env steps per `step`; rewards and costs add up.
        render_mode: `rgb_array` gives pictures for people: what `view` says.
        view: `map` from above (uint8 [256, 256, 3]; the default), or `chase` from behind the robot (uint8 [360, 480, 3]), which needs
            OpenGL. With a render mode only.
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
        view: ViewName | None = None,
        upstream_api: bool = False,
        registered: str | None = None,
        **unknown: object,
    ) -> None:
        _refuse_other_task(task, registered)
        _refuse_unknown(task, unknown, ("observation", "action_repeat", "render_mode", "view", "upstream_api"))
        self._task, self._name = _made(task, 1, observation, action_repeat), observation
        self._success_goals = TASKS[task].success_goals
        self._upstream = bool(upstream_api)
        self._goals = 0
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._task.decision_seconds)}
        self.render_mode, self._viewer = render_mode, _viewer(task, self._task, render_mode, view)
        self.action_space = gymnasium.spaces.Box(self._task.action_low, self._task.action_high, dtype=np.float64)
        self.observation_space = _space(self._task, observation)

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
        _refuse_reset_options(options)
        layout = int(self.np_random.integers(SEED_LIMIT)) if seed is None else seed
        self._goals = 0
        return _first(_chosen(self._task.reset([layout]), self._name)), {}

    def step(self, action: NDArray[Any]) -> tuple[Seen, SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by `action_repeat` env steps under `action` [A].

        Raises:
            TaskError: the action is no finite [A], or the episode has not begun or has ended.
        """
        step = self._task.step(_checked(action, (self._task.action_size,))[None])
        reached = int(step.goals[0])
        self._goals += reached
        terminated = bool(step.terminated[0])
        seen, reward, truncated = _first(_chosen(step.observation, self._name)), float(step.reward[0]), bool(step.ended[0])
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
        """The picture that `view` names.

        Raises:
            UsageError: it needs OpenGL, which cannot be used here.
        """
        return None if self._viewer is None else self._viewer.draw(0)

    def close(self) -> None:
        if self._viewer is not None:
            self._viewer.close()

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Everything that determines the rest of this episode, as plain arrays; `restore` of it is exact to the bit.

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
        return _first(_chosen(seen, self._name))


class TaskVectorEnv(gymnasium.vector.VectorEnv[Any, NDArray[Any], NDArray[Any]]):
    """B episodes of a task, stepped in one call: what `gymnasium.make_vec(id, num_envs=B)` gives.

    Step by step the same as gymnasium's `SyncVectorEnv` over B `TaskEnv`, seed for seed, and several times as fast. An episode that ended
    starts anew in the next step, whose action it ignores (`AutoresetMode.NEXT_STEP`).

    Args:
        num_envs: B, episodes side by side.
        task: as for `TaskEnv`; so are `observation`, `action_repeat`, `render_mode` and `view`.
        observation: see `task`.
        action_repeat: see `task`.
        render_mode: see `task`; `render` gives B pictures.
        threads: threads for physics and cameras; results do not depend on it.
        upstream_api: not there for vectors.
        registered: see `task`.

    Raises:
        UnknownName: no such task.
        UsageError: an unknown option, observation or render mode.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        render_mode: Literal["rgb_array"] | None = None,
        view: ViewName | None = None,
        threads: int = 1,
        upstream_api: bool = False,
        registered: str | None = None,
        **unknown: object,
    ) -> None:
        _refuse_other_task(task, registered)
        _refuse_unknown(task, unknown, ("observation", "action_repeat", "render_mode", "view", "threads"))
        if upstream_api:
            raise UsageError("a vector of environments has no six-tuple", "read infos['cost'], or step single environments")
        self._task, self._name = _made(task, num_envs, observation, action_repeat, threads), observation
        self._success_goals = TASKS[task].success_goals
        self.num_envs = num_envs
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(1.0 / self._task.decision_seconds),
            "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
        }
        self.render_mode, self._viewer = render_mode, _viewer(task, self._task, render_mode, view)
        self.single_action_space = gymnasium.spaces.Box(self._task.action_low, self._task.action_high, dtype=np.float64)
        self.single_observation_space = _space(self._task, observation)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self._goals = np.zeros(num_envs, np.int64)
        self._over = np.zeros(num_envs, np.bool_)
        """[B] the episode ended with the last step, so the next one starts another."""
        self._draws: list[np.random.Generator | None] = [None] * num_envs
        """Per row: draws the layouts of episodes that start without a seed."""
        self._begun = np.zeros(num_envs, np.bool_)
        """[B] an episode was started."""

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Start episodes: row b with `seed + b`, or with the b-th of a list of seeds; None draws a layout.

        `options={"reset_mask": bool [B]}` starts those rows alone, and the others show what they showed; the first reset starts every row.

        Raises:
            UsageError: a wrong number of seeds, a wrong mask, or another option.
        """
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + row for row in range(self.num_envs)]
        seeds = [None] * self.num_envs if seed is None else seed
        if len(seeds) != self.num_envs:
            raise UsageError(f"{len(seeds)} seeds for {self.num_envs} environments")
        options = dict(options or {})
        rows = _mask(options.pop("reset_mask", None), self.num_envs)
        _refuse_reset_options(options)
        if not (rows | self._begun).all():
            left = ", ".join(map(str, np.flatnonzero(~(rows | self._begun))))
            raise UsageError(f"options['reset_mask'] leaves out rows that have not begun: {left}", "the first reset starts every row")
        return _chosen(self._start(rows, [seeds[row] for row in np.flatnonzero(rows)]), self._name), {}

    def step(self, actions: NDArray[Any]) -> tuple[Seen, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every running episode under `actions` [B, A], and start those anew that had ended.

        Raises:
            TaskError: the actions are no finite [B, A], or an episode has not begun.
        """
        control = _checked(actions, (self.num_envs, self._task.action_size))
        fresh = self._over.copy()
        reward, terminated, truncated = np.zeros(self.num_envs), np.zeros_like(fresh), np.zeros_like(fresh)
        infos: dict[str, Any] = {}
        seen: Seen | None = None
        if not fresh.all():
            step = self._task.step(control)
            reward = step.reward  # rows that had ended before have none
            terminated = step.terminated & ~fresh
            truncated = step.ended & ~step.terminated & ~fresh
            self._goals += step.goals
            sources = _info({name: count.astype(np.float64) for name, count in step.sources.items()}, ~fresh)
            success = (self._goals >= self._success_goals) & ~fresh
            infos = _info({"cost": step.cost_env.astype(np.float64), "cost_sources": sources, "success": success}, ~fresh)
            infos |= _info({"goals": np.where(fresh, 0, self._goals)}, ~fresh)
            seen = _chosen(step.observation, self._name)
        if fresh.any():
            begun = _chosen(self._start(fresh, [None] * int(fresh.sum())), self._name)
            seen = begun if seen is None else _merged(fresh, begun, seen)
        assert seen is not None
        self._over = terminated | truncated
        return seen, reward, terminated, truncated, infos

    def render(self) -> tuple[Pixels, ...] | None:
        """The picture that `view` names, of each episode."""
        return None if self._viewer is None else tuple(self._viewer.draw(row) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Give an OpenGL context back."""
        if self._viewer is not None:
            self._viewer.close()

    def _start(self, rows: Bools, seeds: list[int | None]) -> Observation:
        layouts = []
        for row, seed in zip(np.flatnonzero(rows).tolist(), seeds, strict=True):
            draws = self._draws[row]
            if seed is not None or draws is None:
                draws, _ = gymnasium.utils.seeding.np_random(seed)
                self._draws[row] = draws
            layouts.append(int(draws.integers(SEED_LIMIT)) if seed is None else seed)
        self._goals[rows] = 0
        self._over[rows] = False
        seen = self._task.reset(layouts, rows)
        self._begun |= rows
        return seen


def upstream(task: str, **options: Any) -> gymnasium.Env[Any, NDArray[Any]]:
    """A task under the reference package's interface: stands for `safety_gymnasium.make(task)` in code that is to be ported.

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
                vector_entry_point="wasp_cli.tasks.gym:TaskVectorEnv",
                disable_env_checker=True,
                kwargs={"task": name, "registered": name},
            )


# -- shared by one and by many ---------------------------------------------------------------------------------------------------------


def _made(task: str, batch: int, observation: str, action_repeat: int, threads: int = 1) -> VectorTask:
    if observation not in (known := get_args(ObservationName)):
        raise UsageError(f"task '{task}' has no observation '{observation}'", did_you_mean(str(observation), known))
    for option, value in (("num_envs", batch), ("action_repeat", action_repeat), ("threads", threads)):
        if not isinstance(value, int | np.integer) or value < 1:
            raise UsageError(f"{option} should be an integer of at least 1, not {value!r}")
    observe = Observation._fields if observation == "all" else (observation,)
    return make_task(task, batch, action_repeat=action_repeat, observe=observe, threads=threads)


def _viewer(task: str, made: VectorTask, mode: str | None, view: ViewName | None) -> Viewer | None:
    if view is not None and view not in (known := get_args(ViewName)):
        raise UsageError(f"task '{task}' has no view '{view}'", did_you_mean(str(view), known))
    if mode is None:
        if view is not None:
            raise UsageError(f"view '{view}' of task '{task}' without a render mode", "add render_mode='rgb_array', or leave the view out")
        return None
    if mode != "rgb_array" or not isinstance(made, HasScene):
        raise UsageError(f"task '{task}' cannot render '{mode}'", "render_mode is None or 'rgb_array'")
    return Viewer(made, view or "map")


def _refuse_other_task(task: str, registered: str | None) -> None:
    """An id stands for its task: results under its name must not be those of another."""
    if registered is not None and task != registered:
        hint = f"that is gymnasium.make('{TASKS[task].gym_id}')" if task in TASKS else "leave task= out"
        raise UsageError(f"'{TASKS[registered].gym_id}' is the task '{registered}', and task={task!r} cannot change it", hint)


def _refuse_unknown(task: str, unknown: dict[str, object], known: tuple[str, ...]) -> None:
    for option in unknown:
        raise UsageError(f"task '{task}' has no option '{option}'", did_you_mean(option, known))


def _refuse_reset_options(options: dict[str, Any] | None) -> None:
    for option in options or {}:
        raise UsageError(f"reset has no option '{option}'", "a seed names a layout; there is nothing else to choose")


def _space(task: VectorTask, observation: str) -> gymnasium.Space[Any]:
    spaces: dict[str, gymnasium.Space[Any]] = {
        "state": gymnasium.spaces.Box(-np.inf, np.inf, (task.state_size,), np.float64),
        "pixels": gymnasium.spaces.Box(0, 255, (6, CAMERA_SIZE, CAMERA_SIZE), np.uint8),
        "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (task.privileged_size,), np.float32),
    }
    return gymnasium.spaces.Dict(spaces) if observation == "all" else spaces[observation]


def _chosen(observation: Observation, name: str) -> Seen:
    """What was asked for, [B, ...]."""
    fields: dict[str, NDArray[Any]] = {field: value for field, value in observation._asdict().items() if value is not None}
    return fields if name == "all" else fields[name]


def _first(seen: Seen) -> Seen:
    return {name: value[0] for name, value in seen.items()} if isinstance(seen, dict) else seen[0]


def _merged(rows: Bools, ours: Seen, theirs: Seen) -> Seen:
    """`ours` in the rows of a mask, `theirs` in the others."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return {name: cast("NDArray[Any]", _merged(rows, value, theirs[name])) for name, value in ours.items()}
    assert isinstance(ours, np.ndarray)
    assert isinstance(theirs, np.ndarray)
    return np.where(rows.reshape(-1, *[1] * (ours.ndim - 1)), ours, theirs)


def _info(values: dict[str, Any], rows: Bools) -> dict[str, Any]:
    """Infos as gymnasium's vectors give them: beside each key a mask of the rows that have it."""
    return {name: value for key, array in values.items() for name, value in ((key, array), (f"_{key}", rows.copy()))}


def _mask(mask: Any, size: int) -> Bools:
    if mask is None:
        return np.ones(size, np.bool_)
    if not isinstance(mask, np.ndarray) or mask.shape != (size,) or mask.dtype != np.bool_ or not mask.any():
        raise UsageError(f"options['reset_mask'] should be an array of {size} bools, at least one of them true")
    return mask


def _checked(action: Any, shape: tuple[int, ...]) -> Floats:
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


register_envs()
