"""The tasks as gymnasium environments:
`gymnasium.make("wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0")`, or a batch by `make_vec`.

Importing this module registers every task under the namespace `wasp/`; MuJoCo is imported when one
is made.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, SupportsFloat, cast, get_args

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UnknownName, UnknownOption, UsageError, did_you_mean
from wasp_cli.tasks.base import CAMERA_SIZE, MAP_SIZE, Floats, Observation, Pixels, Step, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS, task_named
from wasp_cli.tasks.vision import sensor_shapes, with_vision

# an observation: an array, or with `all` and `vision` a dictionary
Seen = NDArray[Any] | dict[str, NDArray[Any]]
OPTIONS = ("observation", "action_repeat", "render_mode", "width", "height", "upstream_api")
_UPSTREAM_ID = re.compile(
    r"(?P<name>.*?)(?P<vision>Vision)?(?P<five>Gymnasium)?(?P<debug>Debug)?(?P<version>-v\d+)"
)
ObservationName = Literal["state", "pixels", "privileged", "all", "vision"]
_FIELDS: Mapping[str, tuple[str, ...]] = {"all": Observation._fields, "vision": ("pixels", "state")}
"""Fields of the task's observation that an environment's is made of, where its name is not that
of the field.
"""


def observed_task(
    task: str, batch: int, observation: str, action_repeat: int, threads: int = 1
) -> VectorTask:
    if observation not in (known := get_args(ObservationName)):
        raise UsageError(
            f"task '{task}' has no observation '{observation}'",
            did_you_mean(str(observation), known),
        )
    for option, value in (
        ("num_envs", batch),
        ("action_repeat", action_repeat),
        ("threads", threads),
    ):
        if not isinstance(value, int | np.integer) or value < 1:
            raise UsageError(f"{option} should be an integer of at least 1, not {value!r}")
    return make_task(
        task,
        batch,
        action_repeat=action_repeat,
        observe=_FIELDS.get(observation, (observation,)),
        threads=threads,
    )


def refuse_other_task(task: str, registered: str | None) -> None:
    """Refuse another task under an id that stands for one: results under its name must not be
    those of another.
    """
    if registered is not None and task != registered:
        hint = (
            f"that is gymnasium.make('{TASKS[task].gym_id}')"
            if task in TASKS
            else "leave task= out"
        )
        raise UsageError(
            f"'{TASKS[registered].gym_id}' is the task '{registered}', and task={task!r} "
            "cannot change it",
            hint,
        )


def refuse_unknown(made: str, task: str, options: Iterable[str], known: tuple[str, ...]) -> None:
    for option in (option for option in options if option not in known):
        words = f"{made}.__init__() got an unexpected keyword argument '{option}'"
        raise UnknownOption(
            f"{words}: task '{task}' has no option '{option}' ({did_you_mean(option, known)})"
        )


def drawn_layout(draws: np.random.Generator, seed: int | None) -> int:
    """Return the layout that a seed names; without one, or of one beyond the layouts, the next
    that a generator (seeded with it) draws.
    """
    return int(draws.integers(SEED_LIMIT)) if seed is None or seed >= SEED_LIMIT else int(seed)


def space_of(task: VectorTask, observation: str) -> gymnasium.Space[Any]:
    if observation == "vision":
        image = gymnasium.spaces.Box(0, 255, (CAMERA_SIZE, CAMERA_SIZE, 3), np.uint8)
        sensors = {
            name: gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)
            for name, shape in sensor_shapes(task).items()
        }
        return gymnasium.spaces.Dict({**sensors, "vision": image})
    spaces: dict[str, gymnasium.Space[Any]] = {
        "state": gymnasium.spaces.Box(-np.inf, np.inf, (task.state_size,), np.float64),
        "pixels": gymnasium.spaces.Box(0, 255, (6, CAMERA_SIZE, CAMERA_SIZE), np.uint8),
        "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (task.privileged_size,), np.float32),
    }
    return gymnasium.spaces.Dict(spaces) if observation == "all" else spaces[observation]


def shown(
    task: VectorTask, observation: Observation, row: int, name: str
) -> NDArray[Any] | dict[str, NDArray[Any]]:
    """Return what was asked for of the observation of one episode of a batch: of arrays [B,
    ...] those of a row [...].
    """
    fields: dict[str, NDArray[Any]] = {
        field: value[row : row + 1]
        for field, value in observation._asdict().items()
        if value is not None
    }
    if name not in _FIELDS:
        one: NDArray[Any] = fields[name][0]
        return one
    if name == "vision":
        fields = with_vision(task, Observation(fields["pixels"], fields["state"], None))
    return {field: value[0] for field, value in fields.items()}


def checked_control(action: Any, shape: tuple[int, ...]) -> Floats:
    try:
        given = np.asarray(action)
        # NumPy would drop imaginary parts, and read texts of digits.
        if given.dtype.kind not in "biufO":
            raise TypeError(given.dtype)
        control = given.astype(np.float64)
    except (TypeError, ValueError) as error:
        kind = (
            f"{type(action).__name__} of {action.dtype}"
            if isinstance(action, np.ndarray)
            else type(action).__name__
        )
        raise TaskError(f"an action is an array of real numbers, not {kind}") from error
    if control.shape != shape:
        raise TaskError(f"action has shape {control.shape}, expected {shape}")
    if not np.isfinite(control).all():
        raise TaskError(f"action is not finite: {control.tolist()}")
    return control


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
        self._task, self._observation = self._made(task, observation, action_repeat), observation
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
        self.render_mode, self._map_size = render_mode, int(width)
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
        return self._task.max_decisions

    @property
    def spec(self) -> EnvSpec | None:  # gymnasium sets it after making the environment
        if self._spec is None:
            return None
        return replace(
            self._spec, max_episode_steps=self._spec.max_episode_steps or self.max_episode_steps
        )

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
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
        return self._seen(self._task.reset([drawn_layout(self.np_random, seed)], rows)), self._info(
            None
        )

    def step(self, action: NDArray[Any]) -> tuple[Seen, SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by `action_repeat` env steps under `action` [A]."""
        step, row = self._advance(action), self._row
        self._goals += int(step.goals[row])
        seen, info = self._seen(step.observation), self._info(step)
        reward, terminated = float(step.reward[row]), bool(step.terminated[row])
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
        """What is told of a step, or without one of a reset; in the reference package's keys where
        its six values are given.

        All values are NumPy's, as TorchRL's reader wants them.
        """
        cost = np.float64(0 if step is None else step.cost_env[self._row])
        counts = {
            name: 0 if step is None else step.sources[name][self._row]
            for name in self._task.cost_sources
        }
        sources = {f"cost_{name}": np.float64(count) for name, count in counts.items()}
        if self._upstream:
            met = {"goal_met": True} if step is not None and step.goals[self._row] else {}
            return {**sources, "cost_sum": cost, **met}
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
        # Not above: it imports MuJoCo, and a registered task does not need it before it is made.
        from wasp_cli.tasks.camera.topdown import from_above

        assert isinstance(self._task, HasScene)
        return from_above(self._task, self._row, self._map_size)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return everything that determines the rest of this episode, as plain arrays; `restore` of
        it is exact to the bit.

        Which layouts later resets without a seed draw is not part of it (a copy of the environment
        keeps that too).
        """
        arrays = {
            name: array[self._row : self._row + 1] for name, array in self._task.snapshot().items()
        }
        return {**arrays, "goals_reached": np.array([self._goals])}

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Seen:
        """Return to a snapshot of an environment with the same task and options, and see what
        was seen there.
        """
        if "goals_reached" not in snapshot:
            raise TaskError("the snapshot is not one of an environment: 'goals_reached' is missing")
        observation = self._task.restore(
            {name: array for name, array in snapshot.items() if name != "goals_reached"}
        )
        self._goals = int(snapshot["goals_reached"][0])
        return self._seen(observation)


VECTOR_OPTIONS = (
    *(name for name in OPTIONS if name != "upstream_api"),
    "threads",
    "autoreset_mode",
    "max_episode_steps",
)


@dataclass
class _Batch:
    """What the rows of a vector share."""

    task: VectorTask
    step: Step | None = None  # the last one, of all rows


class _Row(TaskEnv):
    """One episode of a batch, which its vector advances."""

    def __init__(self, batch: _Batch, row: int, **options: Any) -> None:
        self._batch, self._row = batch, row
        super().__init__(**options)

    def _made(self, task: str, observation: str, action_repeat: int) -> VectorTask:
        return self._batch.task

    def _advance(self, action: NDArray[Any]) -> Step:
        assert self._batch.step is not None
        return self._batch.step


class TaskVectorEnv(SyncVectorEnv):
    """B episodes of a task, stepped in one call: what `gymnasium.make_vec(id, num_envs=B)` gives.

    It is gymnasium's `SyncVectorEnv`, the same step by step, but physics and cameras of all rows
    are computed together, which is several times as fast. A copy (`copy.deepcopy`, pickle) goes on
    bit for bit.

    Arguments are those of `TaskEnv`. `autoreset_mode` says what becomes of an episode that ended:
    another starts with the next step, whose action it ignores (`NextStep`), with the same step
    (`SameStep`; the last observation is `infos["final_obs"]`), or when `reset` is called
    (`Disabled`). `threads` of physics and cameras change no result. `max_episode_steps` truncates
    episodes earlier than the task does.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        threads: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        registered: str | None = None,
        **options: Any,
    ) -> None:
        refuse_other_task(task, registered)
        refuse_unknown("TaskVectorEnv", task, options, VECTOR_OPTIONS)
        self._batch = _Batch(observed_task(task, num_envs, observation, action_repeat, threads))
        options = {"task": task, "observation": observation, **options}

        def made(row: int) -> gymnasium.Env[Any, Any]:
            env = _Row(self._batch, row, **options)
            return (
                env
                if max_episode_steps is None
                else gymnasium.wrappers.TimeLimit(env, max_episode_steps)
            )

        super().__init__(
            [partial(made, row) for row in range(num_envs)], autoreset_mode=autoreset_mode
        )
        self.env_fns = ()  # no pickle could hold them

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Advance every running episode under `actions` [B, A], and start those anew whose turn
        it is (see `autoreset_mode`).
        """
        control = checked_control(actions, (self.num_envs, self._batch.task.action_size))
        over = self._autoreset_envs
        if self.autoreset_mode is AutoresetMode.DISABLED and over.any():
            ended = ", ".join(map(str, np.flatnonzero(over)))
            raise TaskError(
                f"step after the end of row {ended}",
                "call reset(options={'reset_mask': terminated | truncated})",
            )
        if not (self.autoreset_mode is AutoresetMode.NEXT_STEP and over.all()):
            self._batch.step = self._batch.task.step(control)
        return super().step(control)


def upstream(id: str, **options: Any) -> gymnasium.Env[Any, NDArray[Any]]:
    """Make a task that takes actions [A] and gives the reference package's six values: stands for
    `safety_gymnasium.make(id)`.

    `id` is `SafetyPointGoal1-v0`, with or without `wasp/`, or a name such as `goal1`.
    `...Vision-v0` is the same with `observation="vision"`, `...Gymnasium-v0` the same with
    gymnasium's five values. `options` are those of `TaskEnv`.
    """
    parts = _UPSTREAM_ID.fullmatch(id)
    if parts is not None and parts["debug"]:
        raise UsageError(
            f"there is no '{id}': its robot is driven with the keyboard", "leave 'Debug' out"
        )
    task = task_named(id if parts is None else parts["name"] + parts["version"])
    if task not in TASKS:  # somebody else's gymnasium id
        raise UnknownName("task", id, [*TASKS, *(TASKS[known].gym_id for known in TASKS)])
    five_values = bool(parts and parts["five"])
    for option in {"max_episode_steps", "disable_env_checker"} & options.keys():
        if not five_values:
            words = f"upstream() got an unexpected keyword argument '{option}'"
            raise UnknownOption(
                f"{words}: gymnasium's wrappers want five values, which ...Gymnasium-v0 gives"
            )
    if not (mode := options.get("render_mode") or "rgb_array").startswith("rgb_array"):
        raise UsageError(
            f"task '{task}' cannot render '{mode}'",
            "render_mode is None or 'rgb_array', a map from above",
        )
    if parts is not None and parts["vision"]:
        options = {"observation": "vision", **options}
    return gymnasium.make(TASKS[task].gym_id, **{"upstream_api": not five_values, **options})


def register_envs() -> None:
    for name in TASKS:
        info = TASKS[name]
        if info.gym_id not in gymnasium.registry:
            # The tasks keep their own time limit, which is why no TimeLimit wrapper is asked for;
            # and they check actions themselves, while gymnasium's checker would refuse the
            # six-tuple.
            gymnasium.register(
                id=info.gym_id,
                entry_point="wasp_cli.tasks.gym:TaskEnv",
                vector_entry_point="wasp_cli.tasks.gym:TaskVectorEnv",
                disable_env_checker=True,
                kwargs={"task": name, "registered": name},
            )


register_envs()
