"""The tasks by name. Adding one is a module with its class and one line here."""

from __future__ import annotations

from dataclasses import dataclass

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

    @property
    def implemented(self) -> bool:
        return bool(self.target)


TASKS: Registry[TaskInfo] = Registry(
    "task",
    "wasp.tasks",
    (
        TaskInfo("race1", "Race1", "wasp/SafetyCarRace1-v0", "", 0.04, 500, 1),
        TaskInfo("formula1", "FormulaOne1", "wasp/SafetyCarFormulaOne1-v0", "", 0.04, 1000, 1),
        TaskInfo("goal1", "Goal1", "wasp/SafetyPointGoal1-v0", "wasp_cli.tasks.goal1:Goal1", 0.02, 1000, 7),
    ),
)


def require_implemented(info: TaskInfo) -> None:
    """Raise UsageError when a task is only known by name."""
    if not info.implemented:
        available = ", ".join(name for name in TASKS if TASKS[name].implemented)
        raise UsageError(f"task '{info.name}' ({info.gym_id}) is not implemented in this version", f"available: {available}")
