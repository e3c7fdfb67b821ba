"""Every registered task in plain values, for `wasp tasks`. What a task does not say in its registry is asked of the task itself."""

from __future__ import annotations

from dataclasses import dataclass, replace

from wasp_cli.tasks.base import CAMERA_SIZE
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS


@dataclass(frozen=True)
class Description:
    """What people want to know of a task. The last fields are None where the task is not implemented in this version."""

    name: str
    title: str
    gym_id: str
    implemented: bool
    env_steps: int
    """Time limit in env steps."""
    seconds: float
    """Time limit in simulated seconds."""
    success_goals: int
    """Goals (stages) within the time limit that count as success."""
    state_size: int | None = None
    pixels_shape: tuple[int, int, int] | None = None
    privileged_size: int | None = None
    action_low: tuple[float, ...] | None = None
    action_high: tuple[float, ...] | None = None
    cost_sources: tuple[str, ...] | None = None


def describe() -> list[Description]:
    """A description of each registered task, in the order of the registry."""
    return [_described(name) for name in TASKS]


def _described(name: str) -> Description:
    info = TASKS[name]
    known = Description(
        name, info.title, info.gym_id, info.implemented, info.env_steps, round(info.env_steps * info.env_seconds, 6), info.success_goals
    )
    if not info.implemented:
        return known
    task = make_task(name, 1, observe=())  # without a camera, which would take most of the time
    return replace(
        known,
        state_size=task.state_size,
        pixels_shape=(6, CAMERA_SIZE, CAMERA_SIZE),
        privileged_size=task.privileged_size,
        action_low=tuple(task.action_low.tolist()),
        action_high=tuple(task.action_high.tolist()),
        cost_sources=task.cost_sources,
    )
