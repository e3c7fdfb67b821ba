"""What a gymnasium environment of a task is made of and given: options, spaces, actions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UnknownOption, UsageError, did_you_mean
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, Observation, VectorTask
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS
from wasp_cli.tasks.vision import sensor_shapes, with_vision

ObservationName = Literal["state", "pixels", "privileged", "all", "vision"]
_FIELDS: Mapping[str, tuple[str, ...]] = {"all": Observation._fields, "vision": ("pixels", "state")}
"""Fields of the task's observation that an environment's is made of, where its name is not that of the field."""


# -- options ----------------------------------------------------------------------------------------------------------------------------


def observed_task(task: str, batch: int, observation: str, action_repeat: int, threads: int = 1) -> VectorTask:
    """Make a batch of a task that shows the asked observation."""
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


def refuse_unknown(made: str, task: str, options: Iterable[str], known: tuple[str, ...]) -> None:
    """Refuse an option that the class `made` does not know, and say what was meant."""
    for option in (option for option in options if option not in known):
        words = f"{made}.__init__() got an unexpected keyword argument '{option}'"
        raise UnknownOption(f"{words}: task '{task}' has no option '{option}' ({did_you_mean(option, known)})")


def drawn_layout(draws: np.random.Generator, seed: int | None) -> int:
    """Return the layout that a seed names; without one, or of one beyond the layouts, the next that a generator (seeded with it) draws."""
    return int(draws.integers(SEED_LIMIT)) if seed is None or seed >= SEED_LIMIT else int(seed)


# -- spaces and observations ------------------------------------------------------------------------------------------------------------


def space_of(task: VectorTask, observation: str) -> gymnasium.Space[Any]:
    """Return the space of one episode's observation."""
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


def shown(task: VectorTask, observation: Observation, row: int, name: str) -> NDArray[Any] | dict[str, NDArray[Any]]:
    """Return what was asked for of the observation of one episode of a batch: of arrays [B, ...] those of a row [...]."""
    fields: dict[str, NDArray[Any]] = {field: value[row : row + 1] for field, value in observation._asdict().items() if value is not None}
    if name not in _FIELDS:
        one: NDArray[Any] = fields[name][0]
        return one
    if name == "vision":
        fields = with_vision(task, Observation(fields["pixels"], fields["state"], None))
    return {field: value[0] for field, value in fields.items()}


# -- actions ----------------------------------------------------------------------------------------------------------------------------


def checked_control(action: Any, shape: tuple[int, ...]) -> Floats:
    """Return an action as float64 of a shape."""
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
