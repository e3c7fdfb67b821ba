"""The tasks by name. Adding one is a module with its class and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from wasp_cli.errors import UsageError
from wasp_cli.registry import Registry


@dataclass(frozen=True)
class TaskInfo:
    """What is known of a task without importing MuJoCo."""

    name: str
    title: str
    """Name in tables."""
    gym_id: str
    target: str
    """Import string of the `VectorTask` class; empty while the task is not implemented."""
    env_seconds: float
    """Simulated time of one env step in seconds."""
    env_steps: int
    """Time limit in env steps."""
    success_goals: int
    """Goals (stages) within the time limit that count as success."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What the class is built with, beside what `make_task` passes."""

    @property
    def implemented(self) -> bool:
        return bool(self.target)


_GOAL, _RACE, _FORMULA = "wasp_cli.tasks.goal.task:Goal", "wasp_cli.tasks.race.task:Race", "wasp_cli.tasks.formula.task:Formula"

TASKS: Registry[TaskInfo] = Registry(
    "task",
    "wasp.tasks",
    (
        TaskInfo("race1", "Race1", "wasp/SafetyCarRace1-v0", _RACE, 0.04, 500, 1, {"level": 1}),
        TaskInfo("formula1", "FormulaOne1", "wasp/SafetyCarFormulaOne1-v0", _FORMULA, 0.04, 1000, 1, {"level": 1}),
        TaskInfo("goal1", "Goal1", "wasp/SafetyPointGoal1-v0", _GOAL, 0.02, 1000, 7, {"level": 1}),
        TaskInfo("race0", "Race0", "wasp/SafetyCarRace0-v0", _RACE, 0.04, 500, 1, {"level": 0}),
        TaskInfo("formula0", "FormulaOne0", "wasp/SafetyCarFormulaOne0-v0", _FORMULA, 0.04, 1000, 1, {"level": 0}),
        TaskInfo("goal0", "Goal0", "wasp/SafetyPointGoal0-v0", _GOAL, 0.02, 1000, 7, {"level": 0}),
        TaskInfo("goal2", "Goal2", "wasp/SafetyPointGoal2-v0", _GOAL, 0.02, 1000, 7, {"level": 2}),
    ),
)


def require_implemented(info: TaskInfo) -> None:
    """Raise UsageError when a task is only known by name."""
    if not info.implemented:
        available = ", ".join(name for name in TASKS if TASKS[name].implemented)
        raise UsageError(f"task '{info.name}' ({info.gym_id}) is not implemented in this version", f"available: {available}")
