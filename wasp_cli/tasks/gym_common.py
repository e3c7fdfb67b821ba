"""What a single gymnasium environment of a task and a batch of them share: options, spaces, actions, info and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UnknownOption, UsageError, did_you_mean
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, Observation, Pixels, Step, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS
from wasp_cli.tasks.vision import sensor_shapes, with_vision

ObservationName = Literal["state", "pixels", "privileged", "all", "vision"]
Seen = NDArray[Any] | dict[str, NDArray[Any]]
"""An observation: an array, or with `all` and `vision` a dictionary."""

_FIELDS: Mapping[str, tuple[str, ...]] = {"all": Observation._fields, "vision": ("pixels", "state")}
"""Fields of the task's observation that an environment's is made of, where its name is not that of the field."""


# -- options ----------------------------------------------------------------------------------------------------------------------------


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
    return make_task(task, batch, action_repeat=action_repeat, observe=_FIELDS.get(observation, (observation,)), threads=threads)


def refuse_other_task(task: str, registered: str | None) -> None:
    """Refuse another task under an id that stands for one: results under its name must not be those of another."""
    if registered is not None and task != registered:
        hint = f"that is gymnasium.make('{TASKS[task].gym_id}')" if task in TASKS else "leave task= out"
        raise UsageError(f"'{TASKS[registered].gym_id}' is the task '{registered}', and task={task!r} cannot change it", hint)


def refuse_unknown(made: str, task: str, unknown: Mapping[str, object], known: tuple[str, ...]) -> None:
    """Name an option that a task does not have, and what was meant.

    Args:
        made: name of the class that is being made.
        task: name of the task.
        unknown: options with their values.
        known: names that there are.

    Raises:
        UnknownOption: there is one.
    """
    for option in unknown:
        words = f"{made}.__init__() got an unexpected keyword argument '{option}'"
        raise UnknownOption(f"{words}: task '{task}' has no option '{option}' ({did_you_mean(option, known)})")


def refuse_reset_options(options: dict[str, Any] | None) -> None:
    """Refuse options of a reset: nothing about it can be chosen.

    Raises:
        UsageError: there is an option.
    """
    for option in options or {}:
        raise UsageError(f"reset has no option '{option}'", "a seed names a layout; there is nothing else to choose")


def drawn_layout(draws: np.random.Generator, seed: int | None) -> int:
    """Return the layout that a seed names; without one, or of one beyond the layouts, the next that a generator (seeded with it) draws."""
    return int(draws.integers(SEED_LIMIT)) if seed is None or seed >= SEED_LIMIT else int(seed)


def limited_spec(spec: EnvSpec, steps: int) -> EnvSpec:
    """Return a copy of a spec that says after how many steps an episode is over, unless it says so already."""
    limit = steps if spec.max_episode_steps is None else spec.max_episode_steps
    return replace(spec, max_episode_steps=limit)


# -- spaces and observations ------------------------------------------------------------------------------------------------------------


def space_of(task: VectorTask, observation: str) -> gymnasium.Space[Any]:
    """Return the space of one episode's observation.

    Raises:
        UsageError: the task has no such observation.
    """
    if observation == "vision":
        image = gymnasium.spaces.Box(0, 255, (CAMERA_SIZE, CAMERA_SIZE, 3), np.uint8)
        sensors = {name: gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64) for name, shape in sensor_shapes(task).items()}
        return gymnasium.spaces.Dict({**sensors, "vision": image})
    spaces: dict[str, gymnasium.Space[Any]] = {
        "state": gymnasium.spaces.Box(-np.inf, np.inf, (task.state_size,), np.float64),
        "pixels": gymnasium.spaces.Box(0, 255, (6, CAMERA_SIZE, CAMERA_SIZE), np.uint8),
        "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (task.privileged_size,), np.float32),
    }
    return gymnasium.spaces.Dict(spaces) if observation == "all" else spaces[observation]


def chosen_fields(task: VectorTask, observation: Observation, name: str) -> Seen:
    """Return what was asked for of an observation, [B, ...]."""
    if name == "vision":
        return with_vision(task, observation)
    fields: dict[str, NDArray[Any]] = {field: value for field, value in observation._asdict().items() if value is not None}
    return fields if name == "all" else fields[name]


def row_of(seen: Seen, row: int) -> Seen:
    """Return the observation of one episode of a batch."""
    return {name: value[row] for name, value in seen.items()} if isinstance(seen, dict) else seen[row]


# -- actions and info -------------------------------------------------------------------------------------------------------------------


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


class Info(NamedTuple):
    """What `info` tells of B episodes, by key; the same keys after a reset, with zeros, as after a step."""

    cost: Floats
    """[B]"""
    sources: dict[str, Floats]
    """[B] by cost source."""
    goals: NDArray[np.int64]
    """[B] reached in the episode so far."""
    success: NDArray[np.bool_]
    """[B] as many as the task asks for."""

    @classmethod
    def zeros(cls, task: VectorTask) -> Info:
        """Return the info of B episodes that begin."""
        batch = task.batch
        sources = {name: np.zeros(batch) for name in task.cost_sources}
        return cls(np.zeros(batch), sources, np.zeros(batch, np.int64), np.zeros(batch, np.bool_))

    @classmethod
    def of(cls, step: Step, goals: NDArray[np.int64], success: NDArray[np.bool_]) -> Info:
        """Return the info of a step, with what is counted over the episode: `goals` [B] and `success` [B]."""
        sources = {name: count.astype(np.float64) for name, count in step.sources.items()}
        return cls(step.cost_env.astype(np.float64), sources, goals, success)

    def row(self, row: int) -> dict[str, Any]:
        """Return the `info` of one episode, in which every value is NumPy's, as TorchRL's reader wants them."""
        costs = {name: value[row] for name, value in self._costs().items()}
        # An array of no axes: of NumPy's bools gymnasium's vectors would make objects.
        return {**costs, "goals": self.goals[row], "success": np.array(self.success[row])}

    def only(self, rows: NDArray[np.bool_]) -> Info:
        """Return the same with zeros in all but some rows [B]."""
        if rows.all():
            return self
        sources = {name: np.where(rows, value, 0.0) for name, value in self.sources.items()}
        return Info(np.where(rows, self.cost, 0.0), sources, np.where(rows, self.goals, 0), self.success & rows)

    def batch(self, rows: NDArray[np.bool_]) -> dict[str, Any]:
        """Return `infos` as gymnasium's vectors give them: beside each key a mask of the rows [B] that have it, zeros elsewhere."""
        shown = self.only(rows)
        return masked({**shown._costs(), "goals": shown.goals, "success": shown.success}, rows)

    def _costs(self) -> dict[str, Floats]:
        """By the reference package's names, [B] each."""
        return {"cost": self.cost, "cost_sum": self.cost.copy(), **{f"cost_{name}": value for name, value in self.sources.items()}}


def masked(values: dict[str, Any], rows: NDArray[np.bool_]) -> dict[str, Any]:
    """Set beside each key a mask of the rows [B] that have it."""
    return {name: value for key, array in values.items() for name, value in ((key, array), (f"_{key}", rows.copy()))}


# -- pictures ---------------------------------------------------------------------------------------------------------------------------


class Maps:
    """Draws episodes as maps from above, for people.

    Args:
        name: of the task.
        task: what is drawn.
        mode: `rgb_array`, or None for no pictures.
        width: in pixels.
        height: the same, since maps are square.

    Raises:
        UsageError: a mode that the task does not have, or a map that is not square.
    """

    def __init__(self, name: str, task: VectorTask, mode: str | None, width: int, height: int) -> None:
        if mode is not None and (mode != "rgb_array" or not isinstance(task, HasScene)):
            raise UsageError(f"task '{name}' cannot render '{mode}'", "render_mode is None or 'rgb_array'")
        if width != height or not isinstance(width, int | np.integer) or width < 1:
            raise UsageError(f"a map is square, and not {width!r} x {height!r} pixels", "give width and height the same number")
        self._drawn = task if mode is not None and isinstance(task, HasScene) else None
        self._size = int(width)

    def draw(self, row: int) -> Pixels | None:
        """Draw one episode, uint8 [height, width, 3]; None without a render mode."""
        if self._drawn is None:
            return None
        # Not above: it imports MuJoCo, and a registered task does not need it before it is made.
        from wasp_cli.tasks.camera.topdown import from_above

        return from_above(self._drawn, row, self._size)
