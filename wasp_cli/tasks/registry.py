"""The tasks by name. Adding one is a class and a line here; every gymnasium id is a task too
(see `wasp_cli.tasks.foreign`).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from wasp_cli.errors import UnknownName, closeness, did_you_mean
from wasp_cli.registry import Registry, module_of, require_spelling
from wasp_cli.tasks.declared import Declaration, declaration_of
from wasp_cli.tasks.motors import UNKNOWN, Motors

if TYPE_CHECKING:
    from wasp_cli.tasks.foreign.examine import Facts

Matrix = tuple[tuple[float, ...], ...]
NAMESPACE = "wasp/"  # of our own tasks in gymnasium's registry
_GYM_MODULE = "wasp_cli.tasks.gym:"
_GYM_ID = re.compile(r"(?:[A-Za-z_][\w.]*:)?[\w./-]{1,100}", re.ASCII)
"""`module:namespace/Name-v0`. The alphabet is narrow because names appear in files, tables and
terminals.
"""


@dataclass(frozen=True)
class _Named:
    """What is known of a task by its name alone."""

    name: str
    title: str  # name in tables
    gym_id: str
    target: str  # import string of the `VectorTask` class

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules with which the task's code begins: the keys of its results cover what
        these import.
        """
        return (module_of(self.target),)

    @property
    def image_modules(self) -> tuple[str, ...]:
        """The modules that do nothing but draw what assistants see: nobody else needs them."""
        return ()

    def identity_without_image(self, declaration: Declaration) -> dict[str, Any]:
        """Return what a declaration says to who reads no image."""
        return declaration.plain()

    def facts(self, without: Sequence[str] = ()) -> dict[str, Any]:
        """Return what the registry says of a task and moves results (the time limit, what
        counts as success); its titles do not.

        Args:
            without: modules of the task that are not run.
        """
        return {
            name: getattr(self, name)
            for name in ("name", "env_seconds", "env_steps", "success_goals", "options", "mirror")
        }


@dataclass(frozen=True)
class TaskInfo(_Named):
    """What is known of a task without importing MuJoCo."""

    env_seconds: float  # simulated time of one env step in seconds
    env_steps: int  # time limit in env steps
    success_goals: int  # goals (stages) within the time limit that count as success
    # what the class is built with, beside what `make_task` passes
    options: Mapping[str, Any] = field(default_factory=dict)
    mirror: Matrix | None = None
    """Turns an action [A] into that of the mirrored episode, as rows [A][A], where the task works
    and is seen the same with left and right exchanged: every recorded episode is then another
    possible one. None where it does not, as on a track."""

    motors: Motors = UNKNOWN  # which commands are one and the same force
    informed: bool = False
    """Whether operators know more than the cameras show: they read the privileged observation.
    Assistants imagine them by what the cameras show."""
    cameras: int = 2  # images that assistants see; 0: they see the vector `state` instead


class ForeignInfo(_Named):
    """A gymnasium id of somebody else's. Its numbers are asked of the environment when they are
    first read, which imports its module.

    A report of results needs the name alone, so that it can be printed where the environment is not
    installed.
    """

    options: ClassVar[Mapping[str, Any]] = {}
    # nothing is known of the symmetries of others' environments
    mirror: ClassVar[Matrix | None] = None
    motors: ClassVar[Motors] = UNKNOWN
    informed: ClassVar[bool] = False

    def __init__(self, name: str) -> None:
        declaration = declaration_of(name)
        registered = name if declaration is None else declaration.id
        gym_id = registered.rpartition(":")[2]
        title = gym_id if registered == name else name
        super().__init__(name, title, gym_id, "wasp_cli.tasks.foreign.processes:foreign_task")

    def examine(self) -> Facts:
        """Return what the environment says of itself."""
        # Not above: what plans and reads specs must not import gymnasium for every task.
        from wasp_cli.tasks.foreign.examine import examine

        try:
            return examine(self.name, [*TASKS, *(TASKS[task].gym_id for task in TASKS)])
        except UnknownName as error:
            hint = by_our_names(error.hint or "")
            raise UnknownName(error.kind, error.name, (), error.message, hint) from error

    @property
    def cameras(self) -> int:
        """Images that assistants see: 2, 1, or 0 where they see a vector."""
        return self.examine().views.cameras

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return int(self.examine().action_low.size)

    @property
    def env_seconds(self) -> float:
        return self.examine().env_seconds

    @property
    def env_steps(self) -> int:
        return self.examine().env_steps

    @property
    def success_goals(self) -> int:
        return self.examine().success_goals

    @property
    def modules(self) -> tuple[str, ...]:
        facts = self.examine()
        return (*super().modules, *facts.modules, *facts.files)

    @property
    def image_modules(self) -> tuple[str, ...]:
        return self.examine().image_modules

    def identity_without_image(self, declaration: Declaration) -> dict[str, Any]:
        """Return what a declaration says to who reads vectors alone: another image does not change
        what that one learns. All of it, where the expert learns from the image.
        """
        vector = self.examine().views.privileged
        plain = declaration.plain()
        if vector is None:
            return plain
        plain.pop("image", None)
        return plain | {"vector": vector.names}

    def facts(self, without: Sequence[str] = ()) -> dict[str, Any]:
        """Return how an environment is registered too, which moves results."""
        return super().facts() | {"registered": self.examine().registered(without)}

    def require_independent(self) -> None:
        """Refuse an environment of which many cannot run side by side. Raises TaskError."""
        from wasp_cli.tasks.foreign.examine import require_two

        require_two(self.name)


AnyTaskInfo = TaskInfo | ForeignInfo


class TaskRegistry(Registry[AnyTaskInfo]):
    """The registered tasks; gymnasium ids resolve too, but are not listed."""

    def __getitem__(self, name: str) -> AnyTaskInfo:
        require_spelling("task", name)
        if name not in self and (is_foreign(name) or declaration_of(name) is not None):
            return ForeignInfo(name)
        try:
            return super().__getitem__(name)
        except UnknownName:
            ids = [info.gym_id for info in self.values()]
            if closeness(name, ids) <= closeness(name, self):
                raise
            hint = by_our_names(did_you_mean(name, ids))
            raise UnknownName("task", name, (), otherwise=hint) from None

    def load(self, name: str) -> Any:
        """Return the class of a task, or for a gymnasium id what takes the same arguments."""
        info, made = self[name], super().load(name)
        if not isinstance(info, ForeignInfo):
            return made
        info.examine()
        return functools.partial(made, name)


# of throttle and turn rate: nothing is left or right in Goal but the turning
_TURNING: Matrix = ((1.0, 0.0), (0.0, -1.0))

_WHEELS, _POINT = Motors((0.02, 0.02)), Motors((0.05, 1.0))
"""Of the cars' left and right wheel; of the point robot's throttle and turn rate."""

_TWO = "wasp_cli.tasks.goal.two:TwoGoals"
_GOAL, _RACE, _FORMULA = (
    "wasp_cli.tasks.goal.task:Goal",
    "wasp_cli.tasks.race.task:Race",
    "wasp_cli.tasks.formula.task:Formula",
)

TASKS: Registry[AnyTaskInfo] = TaskRegistry(
    "task",
    "wasp.tasks",
    (
        TaskInfo(
            "race1",
            "Race1",
            "wasp/SafetyCarRace1-v0",
            _RACE,
            0.04,
            500,
            1,
            {"level": 1},
            motors=_WHEELS,
        ),
        TaskInfo(
            "formula1",
            "FormulaOne1",
            "wasp/SafetyCarFormulaOne1-v0",
            _FORMULA,
            0.04,
            1000,
            1,
            {"level": 1},
            motors=_WHEELS,
        ),
        TaskInfo(
            "goal1",
            "Goal1",
            "wasp/SafetyPointGoal1-v0",
            _GOAL,
            0.02,
            1000,
            7,
            {"level": 1},
            _TURNING,
            _POINT,
        ),
        TaskInfo(
            "race0",
            "Race0",
            "wasp/SafetyCarRace0-v0",
            _RACE,
            0.04,
            500,
            1,
            {"level": 0},
            motors=_WHEELS,
        ),
        TaskInfo(
            "formula0",
            "FormulaOne0",
            "wasp/SafetyCarFormulaOne0-v0",
            _FORMULA,
            0.04,
            1000,
            1,
            {"level": 0},
            motors=_WHEELS,
        ),
        TaskInfo(
            "goal0",
            "Goal0",
            "wasp/SafetyPointGoal0-v0",
            _GOAL,
            0.02,
            1000,
            7,
            {"level": 0},
            _TURNING,
            _POINT,
        ),
        TaskInfo(
            "goal2",
            "Goal2",
            "wasp/SafetyPointGoal2-v0",
            _GOAL,
            0.02,
            1000,
            7,
            {"level": 2},
            _TURNING,
            _POINT,
        ),
        TaskInfo(
            "goal1-two",
            "Goal1-Two",
            "wasp/SafetyPointGoalTwo1-v0",
            _TWO,
            0.02,
            1000,
            7,
            {},
            _TURNING,
            _POINT,
            informed=True,
        ),
    ),
)


def is_foreign(name: str) -> bool:
    """Tell whether a name has the form of a gymnasium id that is not ours: `module:Name`,
    `space/Name` or `Name-v0`.
    """
    own = name.removeprefix(_GYM_MODULE).startswith(NAMESPACE)
    marked = ":" in name or "/" in name or re.search(r"-v\d+$", name) is not None
    return marked and not own and _GYM_ID.fullmatch(name) is not None


def by_our_names(hint: str) -> str:
    """Return a hint with our names in the place of our gymnasium ids, which no spec takes."""
    for info in TASKS.values():
        hint = hint.replace(f"'{info.gym_id}'", f"'{info.name}'")
    return hint


def task_named(text: str) -> str:
    """Find a task that people may also call by its gymnasium id: `goal1`,
    `wasp/SafetyPointGoal1-v0`, `SafetyPointGoal1-v0`.
    """
    ids = {TASKS[name].gym_id: name for name in TASKS}
    plain = text.removeprefix(_GYM_MODULE)
    for called in (plain, NAMESPACE + plain):
        if called in ids:
            return ids[called]
    return TASKS[plain].name
