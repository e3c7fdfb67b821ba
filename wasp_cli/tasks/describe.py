"""Every registered task in plain values, for `wasp list tasks`. What a task does not say in its registry is asked of the task itself."""

from __future__ import annotations

from dataclasses import dataclass

from wasp_cli.tasks.base import CAMERA_SIZE
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS


@dataclass(frozen=True)
class Description:
    """What people want to know of a task."""

    name: str
    title: str
    gym_id: str
    env_steps: int  # time limit in env steps
    seconds: float  # time limit in simulated seconds
    success_goals: int  # goals (stages) within the time limit that count as success
    state_size: int
    pixels_shape: tuple[int, int, int]
    privileged_size: int
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    cost_sources: tuple[str, ...]


def describe() -> list[Description]:
    """Describe each registered task, in the order of the registry."""
    return [_described(name) for name in TASKS]


def _described(name: str) -> Description:
    info = TASKS[name]
    task = make_task(name, 1, observe=())  # without a camera, which would take most of the time
    return Description(
        name=name,
        title=info.title,
        gym_id=info.gym_id,
        env_steps=info.env_steps,
        seconds=round(info.env_steps * info.env_seconds, 6),
        success_goals=info.success_goals,
        state_size=task.state_size,
        pixels_shape=(6, CAMERA_SIZE, CAMERA_SIZE),
        privileged_size=task.privileged_size,
        action_low=tuple(task.action_low.tolist()),
        action_high=tuple(task.action_high.tolist()),
        cost_sources=task.cost_sources,
    )
