"""What one gymnasium environment and a vector of them share: options, spaces, and what is chosen of an observation."""

from __future__ import annotations

from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UsageError, did_you_mean
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, HasScene, Observation, VectorTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS
from wasp_cli.tasks.views import Viewer, ViewName

ObservationName = Literal["state", "pixels", "privileged", "all"]
Seen = NDArray[Any] | dict[str, NDArray[Any]]
"""An observation: an array, or with `all` a dictionary of three."""


def observed_task(task: str, batch: int, observation: str, action_repeat: int, threads: int = 1) -> VectorTask:
    """A batch of a task that shows the asked observation.

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


def viewer_of(task: str, made: VectorTask, mode: str | None, view: ViewName | None) -> Viewer | None:
    """What draws the pictures of a render mode; None without one.

    Raises:
        UsageError: a mode or a view that the task does not have.
    """
    if view is not None and view not in (known := get_args(ViewName)):
        raise UsageError(f"task '{task}' has no view '{view}'", did_you_mean(str(view), known))
    if mode is None:
        if view is not None:
            raise UsageError(f"view '{view}' of task '{task}' without a render mode", "add render_mode='rgb_array', or leave the view out")
        return None
    if mode != "rgb_array" or not isinstance(made, HasScene):
        raise UsageError(f"task '{task}' cannot render '{mode}'", "render_mode is None or 'rgb_array'")
    return Viewer(made, view or "map")


def refuse_other_task(task: str, registered: str | None) -> None:
    """An id stands for its task: results under its name must not be those of another."""
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
    """Nothing about a reset can be chosen.

    Raises:
        UsageError: there is an option.
    """
    for option in options or {}:
        raise UsageError(f"reset has no option '{option}'", "a seed names a layout; there is nothing else to choose")


def space_of(task: VectorTask, observation: str) -> gymnasium.Space[Any]:
    """The space of one episode's observation."""
    spaces: dict[str, gymnasium.Space[Any]] = {
        "state": gymnasium.spaces.Box(-np.inf, np.inf, (task.state_size,), np.float64),
        "pixels": gymnasium.spaces.Box(0, 255, (6, CAMERA_SIZE, CAMERA_SIZE), np.uint8),
        "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (task.privileged_size,), np.float32),
    }
    return gymnasium.spaces.Dict(spaces) if observation == "all" else spaces[observation]


def chosen_fields(observation: Observation, name: str) -> Seen:
    """What was asked for, [B, ...]."""
    fields: dict[str, NDArray[Any]] = {field: value for field, value in observation._asdict().items() if value is not None}
    return fields if name == "all" else fields[name]


def first_row(seen: Seen) -> Seen:
    """The observation of the first episode of a batch."""
    return {name: value[0] for name, value in seen.items()} if isinstance(seen, dict) else seen[0]


def checked_control(action: Any, shape: tuple[int, ...]) -> Floats:
    """An action as float64 of a shape.

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
