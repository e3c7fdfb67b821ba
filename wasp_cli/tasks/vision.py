"""The observation of the reference package's `Vision` ids: its sensors by name, and the image
of the front camera.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import Observation, VectorTask
from wasp_cli.tasks.features import BINS

_POINT: dict[str, tuple[int, ...]] = {
    "accelerometer": (3,),
    "velocimeter": (3,),
    "gyro": (3,),
    "magnetometer": (3,),
}
_CAR: dict[str, tuple[int, ...]] = {**_POINT, "ballangvel_rear": (3,), "ballquat_rear": (3, 3)}
_SENSORS = {"point": _POINT, "car": _CAR}
_LIDARS = {
    "goal": ("goal", "hazards", "vases"),
    "race": ("goal", "hazards"),
    "formula": ("staged_goal", "vases"),
}
"""By the task's name, in the order of the state vector; lower levels have the first ones."""


def sensor_shapes(task: VectorTask) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the parts of a task's state vector, in their order, by the reference
    package's names. Raises UsageError for other tasks than Safety-Gymnasium's.
    """
    sensors = _SENSORS.get(getattr(task, "drive", ""))
    lidars = _LIDARS.get(getattr(task, "name", ""))
    if sensors is None or lidars is None:
        raise UsageError(
            "the observation 'vision' is that of Safety-Gymnasium's tasks only",
            "'all' has the images of every task",
        )
    kinds = (task.state_size - sum(map(prod, sensors.values()))) // BINS
    shapes = dict(sensors)
    for lidar in lidars[:kinds]:
        shapes[f"{lidar}_lidar"] = (BINS,)
    return shapes


def with_vision(task: VectorTask, observation: Observation) -> dict[str, NDArray[Any]]:
    """Return the sensors [B, ...] of a state vector by name, and as `vision` the front image,
    uint8 [B, 64, 64, 3].
    """
    assert observation.state is not None
    assert observation.pixels is not None
    parts: dict[str, NDArray[Any]] = {}
    start = 0
    for name, shape in sensor_shapes(task).items():
        end = start + prod(shape)
        parts[name] = observation.state[:, start:end].reshape(-1, *shape)
        start = end
    front = np.moveaxis(observation.pixels[:, :3], 1, -1)
    return {**parts, "vision": np.ascontiguousarray(front)}
