"""What an environment shows: an observation by name, made of the fields of the task's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import UsageError, did_you_mean
from wasp_cli.tasks.base import CAMERA_SIZE, Observation, VectorTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.vision import sensor_shapes, with_vision

# an observation: an array, or with `all` and `vision` a dictionary
Seen = NDArray[Any] | dict[str, NDArray[Any]]
ObservationName = Literal["state", "pixels", "privileged", "all", "vision"]
_FIELDS: Mapping[str, tuple[str, ...]] = {"all": Observation._fields, "vision": ("pixels", "state")}
"""Fields of the task's observation that an environment's is made of, where its name is not that
of the field.
"""


def observed_task(
    task: str, batch: int, observation: str, action_repeat: int, threads: int = 1
) -> VectorTask:
    """Build B = `batch` episodes of a task that fill what an observation is made of. Raises
    UsageError where there is no such observation, or a number is no whole one of at least 1.
    """
    known = get_args(ObservationName)
    if observation not in known:
        raise UsageError(
            f"task '{task}' has no observation '{observation}'",
            did_you_mean(str(observation), known),
        )
    numbers = {"num_envs": batch, "action_repeat": action_repeat, "threads": threads}
    for option, value in numbers.items():
        if not isinstance(value, int | np.integer) or value < 1:
            raise UsageError(f"{option} should be an integer of at least 1, not {value!r}")
    return make_task(
        task,
        batch,
        action_repeat=action_repeat,
        observe=_FIELDS.get(observation, (observation,)),
        threads=threads,
    )


def space_of(task: VectorTask, observation: str) -> gymnasium.Space[Any]:
    """Return the space of an observation of one episode."""
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


def shown(task: VectorTask, observation: Observation, row: int, name: str) -> Seen:
    """Return the observation `name` of one episode of a batch: of arrays [B, ...] that of the row,
    [...].
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
