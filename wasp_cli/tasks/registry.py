"""The tasks by name. A new one is a class and an entry here; every gymnasium id is a task too (see
`wasp_cli.tasks.foreign`).
"""

from __future__ import annotations

import functools
import re
from typing import Any

from wasp_cli.errors import UnknownName, closeness, did_you_mean
from wasp_cli.registry import Registry, require_spelling
from wasp_cli.tasks.declared import declaration_of

# Also public names of this module: plugins import `TaskInfo` from here.
from wasp_cli.tasks.info import AnyTaskInfo as AnyTaskInfo
from wasp_cli.tasks.info import ForeignInfo as ForeignInfo
from wasp_cli.tasks.info import Matrix, by_our_names
from wasp_cli.tasks.info import TaskInfo as TaskInfo
from wasp_cli.tasks.motors import Motors

NAMESPACE = "wasp/"  # of our own tasks in gymnasium's registry
_GYM_MODULE = "wasp_cli.tasks.gym:"
_GYM_ID = re.compile(r"(?:[A-Za-z_][\w.]*:)?[\w./-]{1,100}", re.ASCII)
"""`module:namespace/Name-v0`. The alphabet is narrow because names appear in files, tables and
terminals.
"""


class TaskRegistry(Registry[AnyTaskInfo]):
    """The registered tasks. Gymnasium ids and declared names are found too, but are not listed."""

    def __getitem__(self, name: str) -> AnyTaskInfo:
        """Return what is known of a task. Raises UnknownName."""
        require_spelling("task", name)
        if name not in self and (is_foreign(name) or declaration_of(name) is not None):
            return ForeignInfo(name, self)
        try:
            return super().__getitem__(name)
        except UnknownName:
            ids = [info.gym_id for info in self.values()]
            if closeness(name, ids) <= closeness(name, self):
                raise
            hint = by_our_names(did_you_mean(name, ids), self)
            raise UnknownName("task", name, (), otherwise=hint) from None

    def load(self, name: str) -> Any:
        """Return the class of a task; for an environment of others a function that takes the same
        arguments.
        """
        info = self[name]
        target = super().load(name)
        if not isinstance(info, ForeignInfo):
            return target
        info.examine()
        return functools.partial(target, name)


_WHEELS = Motors((0.02, 0.02))  # of the cars' left and right wheel
_POINT = Motors((0.05, 1.0))  # of the point robot's throttle and turn rate
# of throttle and turn rate: nothing is left or right in Goal but the turning
_TURNING: Matrix = ((1.0, 0.0), (0.0, -1.0))


def _race(level: int) -> TaskInfo:
    return TaskInfo(
        name=f"race{level}",
        title=f"Race{level}",
        gym_id=f"{NAMESPACE}SafetyCarRace{level}-v0",
        target="wasp_cli.tasks.race.task:Race",
        env_seconds=0.04,
        env_steps=500,
        success_goals=1,
        options={"level": level},
        motors=_WHEELS,
    )


def _formula(level: int) -> TaskInfo:
    return TaskInfo(
        name=f"formula{level}",
        title=f"FormulaOne{level}",
        gym_id=f"{NAMESPACE}SafetyCarFormulaOne{level}-v0",
        target="wasp_cli.tasks.formula.task:Formula",
        env_seconds=0.04,
        env_steps=1000,
        success_goals=1,
        options={"level": level},
        motors=_WHEELS,
    )


def _goal(level: int) -> TaskInfo:
    return TaskInfo(
        name=f"goal{level}",
        title=f"Goal{level}",
        gym_id=f"{NAMESPACE}SafetyPointGoal{level}-v0",
        target="wasp_cli.tasks.goal.task:Goal",
        env_seconds=0.02,
        env_steps=1000,
        success_goals=7,
        options={"level": level},
        mirror=_TURNING,
        motors=_POINT,
    )


_TWO_GOALS = TaskInfo(
    name="goal1-two",
    title="Goal1-Two",
    gym_id=f"{NAMESPACE}SafetyPointGoalTwo1-v0",
    target="wasp_cli.tasks.goal.two:TwoGoals",
    env_seconds=0.02,
    env_steps=1000,
    success_goals=7,
    mirror=_TURNING,
    motors=_POINT,
    informed=True,
)

TASKS: Registry[AnyTaskInfo] = TaskRegistry(
    "task",
    "wasp.tasks",
    (
        _race(1),
        _formula(1),
        _goal(1),
        _race(0),
        _formula(0),
        _goal(0),
        _goal(2),
        _TWO_GOALS,
    ),
)


def is_foreign(name: str) -> bool:
    """Tell whether a name has the form of a gymnasium id that is not ours: `module:Name`,
    `space/Name` or `Name-v0`.
    """
    own = name.removeprefix(_GYM_MODULE).startswith(NAMESPACE)
    marked = ":" in name or "/" in name or re.search(r"-v\d+$", name) is not None
    return marked and not own and _GYM_ID.fullmatch(name) is not None


def task_named(text: str) -> str:
    """Return the name of a task, which may be given by its gymnasium id: `goal1`,
    `wasp/SafetyPointGoal1-v0`, `SafetyPointGoal1-v0`. Raises UnknownName.
    """
    ids = {TASKS[name].gym_id: name for name in TASKS}
    plain = text.removeprefix(_GYM_MODULE)
    for called in (plain, NAMESPACE + plain):
        if called in ids:
            return ids[called]
    return TASKS[plain].name
