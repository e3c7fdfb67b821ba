"""What is known of a task by its name, before MuJoCo or the environment of others is imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from wasp_cli.errors import UnknownName
from wasp_cli.registry import module_of
from wasp_cli.tasks.declared import Declaration, declaration_of
from wasp_cli.tasks.motors import UNKNOWN, Motors

if TYPE_CHECKING:
    from wasp_cli.tasks.foreign.examine import Facts

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Named:
    """What every task has, ours or an environment of others."""

    name: str
    title: str  # name in tables
    gym_id: str
    target: str  # import string of the `VectorTask` class

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules with which the task's code begins; keys of its results cover what these
        import.
        """
        return (module_of(self.target),)

    @property
    def image_modules(self) -> tuple[str, ...]:
        """The modules that only draw what assistants see; who reads no image does not need them."""
        return ()

    def identity_without_image(self, declaration: Declaration) -> dict[str, Any]:
        """Return the part of a declaration that counts for a stage that reads no image."""
        return declaration.plain()

    def facts(self, without: Sequence[str] = ()) -> dict[str, Any]:
        """Return what the registry says of a task and moves results (the time limit, what
        counts as success); its titles do not.

        Args:
            without: modules of the task that are not run.
        """
        names = ("name", "env_seconds", "env_steps", "success_goals", "options", "mirror")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class TaskInfo(Named):
    """One of our own tasks, or of a plugin's."""

    env_seconds: float  # simulated time of one env step in seconds
    env_steps: int  # time limit in env steps
    success_goals: int  # goals (stages) within the time limit that count as success
    # what the class is built with, beside what `make_task` passes
    options: Mapping[str, Any] = field(default_factory=dict)
    mirror: Matrix | None = None
    """Turns an action [A] into that of the mirrored episode, as rows [A][A], where the task works
    and is seen the same with left and right exchanged: every recorded episode is then another
    possible one. None where it does not, as on a track."""

    motors: Motors = UNKNOWN  # which commands saturate, and so give the same force
    informed: bool = False
    """Whether operators know more than the cameras show: they read the privileged observation.
    Assistants imagine them by what the cameras show."""
    cameras: int = 2  # images that assistants see; 0: they see the vector `state` instead


class ForeignInfo(Named):
    """An environment of others: a gymnasium id, or a name that was declared. Its numbers are read
    from the environment when they are first asked for, which imports its module.

    A report of results needs the name alone, so that it can be printed where the environment is not
    installed.
    """

    options: ClassVar[Mapping[str, Any]] = {}
    # nothing is known of the symmetries of others' environments
    mirror: ClassVar[Matrix | None] = None
    motors: ClassVar[Motors] = UNKNOWN
    informed: ClassVar[bool] = False
    _ours: Mapping[str, AnyTaskInfo]

    def __init__(self, name: str, ours: Mapping[str, AnyTaskInfo]) -> None:
        """`ours` are the registered tasks, which are suggested where the name is misspelt."""
        declaration = declaration_of(name)
        registered = name if declaration is None else declaration.id
        gym_id = registered.rpartition(":")[2]
        title = gym_id if registered == name else name
        super().__init__(name, title, gym_id, "wasp_cli.tasks.foreign.processes:foreign_task")
        object.__setattr__(self, "_ours", ours)  # a frozen dataclass has no other way

    def examine(self) -> Facts:
        """Return what the environment says of itself.

        Raises:
            UnknownName: nothing is registered under its id.
            TaskError: the environment cannot be made, or is none of which a task can be made.
        """
        # Not above: what plans and reads specs must not import gymnasium for every task.
        from wasp_cli.tasks.foreign.examine import examine

        try:
            names = [*self._ours, *(info.gym_id for info in self._ours.values())]
            return examine(self.name, names)
        except UnknownName as error:
            hint = by_our_names(error.hint or "", self._ours)
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
        """Simulated time of an env step in seconds."""
        return self.examine().env_seconds

    @property
    def env_steps(self) -> int:
        """The time limit in env steps."""
        return self.examine().env_steps

    @property
    def success_goals(self) -> int:
        """Goals within the time limit that count as success."""
        return self.examine().success_goals

    @property
    def modules(self) -> tuple[str, ...]:
        """Our adapter, the environment's modules, and its data files."""
        facts = self.examine()
        return (*super().modules, *facts.modules, *facts.files)

    @property
    def image_modules(self) -> tuple[str, ...]:
        """The modules that the environment names as those that only draw its image."""
        return self.examine().image_modules

    def identity_without_image(self, declaration: Declaration) -> dict[str, Any]:
        """Return a declaration without its image, which does not change what is learned from the
        vectors alone; with it, where the expert learns from the image.
        """
        vector = self.examine().views.privileged
        plain = declaration.plain()
        if vector is None:
            return plain
        plain.pop("image", None)
        return plain | {"vector": vector.names}

    def facts(self, without: Sequence[str] = ()) -> dict[str, Any]:
        """Return the facts of `Named.facts`, and how the environment is registered."""
        return super().facts() | {"registered": self.examine().registered(without)}

    def require_independent(self) -> None:
        """Check that many such environments can run side by side. Raises TaskError."""
        from wasp_cli.tasks.foreign.examine import require_two

        require_two(self.name)


AnyTaskInfo = TaskInfo | ForeignInfo


def by_our_names(hint: str, ours: Mapping[str, AnyTaskInfo]) -> str:
    """Return a hint with our names in the place of our gymnasium ids, which no spec takes."""
    for info in ours.values():
        hint = hint.replace(f"'{info.gym_id}'", f"'{info.name}'")
    return hint
