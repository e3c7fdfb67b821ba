"""What a spec says of an environment: where its image, its vectors, its cost and its success are.

An entry of a spec's `tasks` may be a mapping. It is a `Declaration`, and travels as plain JSON in
the settings of every node (`settings["environment"]`): so it is in the key, in what a worker gets,
and in the manifest of a result. Whoever makes a task of a node or of a stored result first calls
`declare_from`; `TASKS[name]` and `make_task(name, ...)` then find the environment by its name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, JsonValue, field_validator
from pydantic_core import PydanticCustomError

from wasp_cli.config import Config
from wasp_cli.errors import TaskError
from wasp_cli.tasks.references import Reference, reference

ENVIRONMENT = "environment"
"""The name of a declaration in the settings of a node."""
RENDER = "render"
NO_IMAGE = "none"
OBSERVATION = "observation"
MEASURED = "state"
"""The entry of an observation that a function of the declaration fills."""
NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
COST_SOURCE = "cost"
"""The cost source of a declaration that names none."""
USUAL_CONTROLS = {1: ("right",), 2: ("up", "left")}
"""By the number of an action's numbers, the key that raises each where nobody says it."""
_ELSEWHERE = {"name", "action_repeat", "controls"}
"""Fields that do not travel in `settings["environment"]`: nodes have the first two at another
place, and only a person at the controls needs the last.
"""


class DeclarationError(TaskError):
    """An environment that is not as its declaration says; `field` is the name of the wrong line."""

    def __init__(self, field: str, message: str, hint: str | None = None) -> None:
        super().__init__(message, hint)
        self.field = field

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are pickled by their message alone, and this one has two further arguments.
        return type(self), (self.field, self.message, self.hint)


class Declaration(Config):
    """An environment, and where things are in it. A field that is left out is found as it is for
    an environment that is named by its id alone.
    """

    id: str = Field(description="gymnasium id, with the module that registers it: my_pkg:MyEnv-v0")
    name: str | None = Field(
        default=None,
        pattern=NAME,
        description="what the task is called in the spec and in tables; null: its id",
    )
    make: dict[str, JsonValue] = Field(default={}, description="arguments of gymnasium.make")
    image: str | None = Field(
        default=None,
        min_length=1,
        description="what assistants see: `render` (the environment's own render()), an entry of "
        "the observation, `observation` (all of it), or `none` (they see the vectors of `state`)",
    )
    state: str | tuple[str, ...] | None = Field(
        default=None,
        min_length=1,
        description="the vectors that the expert reads, and assistants where there is no image: "
        "`observation` (all of it, flat, without images), entries by name, or module:function, "
        "called as function(env), which returns one",
    )
    cost: str | dict[str, str] | None = Field(
        default=None,
        min_length=1,
        description="info.NAME, `terminated`, or module:function, called as function(env, action, "
        "info); several by name: their sum counts. null: info.cost",
    )
    success: str | None = Field(
        default=None, description="info.NAME, `terminated`, or module:function"
    )
    limit: int | None = Field(
        default=None, ge=1, description="time limit in env steps; null: as it is registered"
    )
    seconds: float | None = Field(
        default=None, gt=0.0, description="of an env step; null: as its metadata says"
    )
    action_repeat: int | None = Field(
        default=None, ge=1, description="env steps per decision; null: the spec's"
    )
    controls: tuple[Literal["up", "down", "left", "right", "none"], ...] | None = Field(
        default=None,
        min_length=1,
        description="for `wasp drive`: the key that raises each number of an action; null: "
        "[right] for one number, [up, left] for two",
    )

    @field_validator("cost", "success")
    @classmethod
    def _refers(cls, value: str | dict[str, str] | None) -> str | dict[str, str] | None:
        """Check that every text is a reference."""
        texts = value.values() if isinstance(value, dict) else [value]
        for text in texts:
            if text is not None:
                _require_reference(text)
        return value

    @field_validator("state")
    @classmethod
    def _names(cls, value: str | tuple[str, ...] | None) -> str | tuple[str, ...] | None:
        """Check that a text with a colon names a function."""
        if isinstance(value, str) and ":" in value:
            _require_reference(value)
        return value

    def plain(self) -> dict[str, Any]:
        """Return what travels in the settings of a node, as JSON values: all fields that are not
        at their defaults, without the name, the action repeat and the controls.
        """
        values = self.identity()
        return {name: value for name, value in values.items() if name not in _ELSEWHERE}

    @property
    def is_bare(self) -> bool:
        """Whether only the id is set, which then is the name of the task."""
        return set(self.plain()) == {"id"} and self.name in (None, self.id)

    @property
    def vectors(self) -> tuple[str, ...] | None:
        """The entries of the observation that are vectors; empty: all of it; None: not declared."""
        if self.state is None:
            return None
        if self.state == OBSERVATION:
            return ()
        if self.measured is not None:
            return (MEASURED,)
        return (self.state,) if isinstance(self.state, str) else self.state

    @property
    def measured(self) -> Reference | None:
        """The function that returns the vector; None where it is in the observation."""
        if isinstance(self.state, str) and ":" in self.state:
            return reference(self.state)
        return None

    @property
    def costs(self) -> dict[str, Reference]:
        """Where each cost source is; empty where none is declared."""
        if self.cost is None:
            return {}
        if isinstance(self.cost, str):
            return {COST_SOURCE: reference(self.cost)}
        return {source: reference(text) for source, text in self.cost.items()}

    @property
    def succeeds(self) -> Reference | None:
        """Where success is; None where it is not declared."""
        return None if self.success is None else reference(self.success)


def _require_reference(text: str) -> None:
    """Raise pydantic's error, with our message and hint, where a text is no reference."""
    try:
        reference(text)
    except TaskError as error:
        context = {"message": error.message, "hint": error.hint or ""}
        raise PydanticCustomError("reference", "{message}", context) from error


_declared: dict[str, Declaration] = {}


def declare(name: str, declaration: Declaration | Mapping[str, Any] | None) -> None:
    """Let a name mean an environment in this process, until the name is declared again.

    Args:
        name: of the task.
        declaration: what the spec declares, also as the JSON of a node's settings; None: the name
            is a gymnasium id, and nothing is declared.

    Raises:
        TaskError: the node's settings do not hold a declaration.
    """
    if isinstance(declaration, Mapping):
        try:
            declaration = Declaration.model_validate_json(json.dumps(declaration), strict=True)
        except ValueError as error:
            raise TaskError(
                f"what is stored of the environment '{name}' is no declaration"
            ) from error
    if declaration is None or declaration.is_bare:
        _declared.pop(name, None)
    else:
        _declared[name] = declaration


def declare_from(task: str, settings: object) -> None:
    """Declare the task of a node or of a stored result from its settings."""
    stored = settings.get(ENVIRONMENT) if isinstance(settings, Mapping) else None
    declare(task, stored if isinstance(stored, Mapping) else None)


def declaration_of(name: str) -> Declaration | None:
    """Return what was declared under a name; None where nothing was."""
    return _declared.get(name)


def text_of(declaration: Declaration | None) -> str:
    """Return a declaration as JSON text, the same for equal ones; for None, `null`."""
    plain = None if declaration is None else declaration.plain()
    return json.dumps(plain, sort_keys=True)
