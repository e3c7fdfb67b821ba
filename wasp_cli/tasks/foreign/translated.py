"""An environment whose `info` has cost and success under the names that WASP reads, from where a
declaration says that they are.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from wasp_cli.errors import WaspError
from wasp_cli.registry import import_here
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.declared import MEASURED, Declaration, DeclarationError
from wasp_cli.tasks.foreign.calls import GymEnv, calling, five_values, number_of, shown
from wasp_cli.tasks.foreign.images import image_form
from wasp_cli.tasks.references import Reference

Function = Callable[[GymEnv, Any, Mapping[str, Any]], Any]
"""Called as function(env, action, info): `action` is what the environment got, `info` what its step
returned."""
FRONT_IMAGE = "image"
"""What an observation is called that is an image, beside what is measured."""
_KINDS = {"cost": "a finite number of at least 0", "success": "True or False"}


class Translated(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """After every step the info has the `cost`, `cost_sources` and `success` that the declaration
    describes; what is not declared stays as it is.
    """

    def __init__(self, env: GymEnv, declaration: Declaration) -> None:
        """Raises DeclarationError: a function of the declaration cannot be imported."""
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, declaration=declaration)
        gymnasium.Wrapper.__init__(self, env)
        self.declaration = declaration
        self._costs = {
            source: _Reading("cost", where) for source, where in declaration.costs.items()
        }
        succeeds = declaration.succeeds
        self._success = None if succeeds is None else _Reading("success", succeeds)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environment, and read its cost and its success."""
        seen, reward, terminated, truncated, info = five_values(self.env.step(action))
        new_info = dict(info)
        if self._costs:
            sources = {
                source: reading.value(self.env, action, info, terminated)
                for source, reading in self._costs.items()
            }
            new_info["cost_sources"] = sources
            new_info["cost"] = sum(sources.values())
        if self._success is not None:
            new_info.pop("goals", None)  # it would count instead
            new_info["success"] = self._success.value(self.env, action, info, terminated) > 0
        return seen, reward, terminated, truncated, new_info


class Measured(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Every observation has what a function measures in the environment, as an entry `state`.

    An observation that is no dictionary becomes one: it is the entry `image`, or `observation`
    where it is no image.
    """

    def __init__(self, env: GymEnv, where: Reference) -> None:
        """Raises DeclarationError: the function cannot be imported, or returns no vector."""
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, where=where)
        gymnasium.Wrapper.__init__(self, env)
        self._where = where
        self._function: Callable[[GymEnv], Any] = _imported(
            "state", where, "(env), which returns a vector"
        )
        space = env.observation_space
        self._entry = ""  # what the observation is called; nothing where it has entries
        if isinstance(space, gymnasium.spaces.Dict):
            below = dict(space.spaces)
        else:
            self._entry = "observation" if image_form(space) is None else FRONT_IMAGE
            below = {self._entry: space}
        with calling("reset"):
            env.reset(seed=0)  # before it, there may be nothing to measure
        vector = gymnasium.spaces.Box(-np.inf, np.inf, self._measure().shape, np.float64)
        self.observation_space = gymnasium.spaces.Dict({**below, MEASURED: vector})

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and measure."""
        seen, info = self.env.reset(**options)
        return self._with_state(seen), info

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environment, and measure."""
        seen, reward, terminated, truncated, info = five_values(self.env.step(action))
        return self._with_state(seen), reward, terminated, truncated, dict(info)

    def _with_state(self, seen: Any) -> dict[str, Any]:
        entries = {self._entry: seen} if self._entry else seen
        return {**entries, MEASURED: self._measure()}

    def _measure(self) -> Floats:
        """What the function returns now, as a vector."""
        with calling(f"state function '{self._where.text}'"):
            value = self._function(self.env)
        try:
            values: Floats = np.asarray(value, np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise DeclarationError(
                "state", f"{self._where.text} is {shown(value)}", "return a list of numbers"
            ) from error
        if not values.size or not np.isfinite(values).all():
            raise DeclarationError(
                "state", f"{self._where.text} is {shown(value)}", "return finite numbers"
            )
        return values


def translated(env: GymEnv, declaration: Declaration) -> GymEnv:
    """Return an environment with the observations and the info that a declaration describes; one
    that has them already is returned as it is.
    """
    if isinstance(env, Translated) and env.declaration == declaration:
        return env
    if declaration.measured is not None:
        env = Measured(env, declaration.measured)
    return Translated(env, declaration)


class _Reading:
    """How one value of a step is read."""

    def __init__(self, field: str, where: Reference) -> None:
        self._field = field
        self._where = where
        self._function: Function | None = None
        if where.module:
            self._function = _imported(field, where, "(env, action, info), which returns a number")

    def value(self, env: GymEnv, action: Any, info: Mapping[str, Any], terminated: object) -> float:
        """Return the value of the step that was just taken.

        Raises:
            DeclarationError: there is none, or it is no number of the kind that is needed.
        """
        if self._function is not None:
            with calling(f"{self._field} function '{self._where.text}'"):
                value = self._function(env, action, info)
        elif self._where.of_end:
            value = terminated
        else:
            value = self._entry(info)
        number = number_of(value)
        if number is None or not math.isfinite(number) or number < 0.0:
            raise DeclarationError(
                self._field,
                f"{self._where.text} is {shown(value)}",
                f"a {self._field} is {_KINDS[self._field]}",
            )
        return number

    def _entry(self, info: Mapping[str, Any]) -> Any:
        """The entry of info that the reference names."""
        value: Any = info
        for depth, name in enumerate(self._where.path):
            if not isinstance(value, Mapping) or name not in value:
                above = ".".join(("info", *self._where.path[:depth]))
                raise DeclarationError(
                    self._field,
                    f"there is no {self._where.text}: {above} {_holds(value)}",
                    "name one of them, or write module:function, which is called as "
                    "function(env, action, info)",
                )
            value = value[name]
        return value


def _holds(value: object) -> str:
    """What a value has in place of an entry that is missing."""
    if not isinstance(value, Mapping):
        return f"is {shown(value)}"
    names = ", ".join(sorted(map(str, value)))
    return f"has {names[:200]}" if names else "is empty"


def _imported(field: str, where: Reference, form: str) -> Callable[..., Any]:
    """Import the function that a reference names; its module may lie in the current folder.

    Args:
        field: of the declaration.
        where: the reference.
        form: arguments and value of the function, for messages.
    """
    try:
        import_here(where.module)
    except WaspError as error:
        raise DeclarationError(field, error.message, error.hint) from error
    function = getattr(importlib.import_module(where.module), where.function, None)
    if not callable(function):
        raise DeclarationError(
            field,
            f"module '{where.module}' has no function '{where.function}'",
            f"write in it: def {where.function}{form}",
        )
    made: Callable[..., Any] = function
    return made


def functions_of(declaration: Declaration | None) -> list[str]:
    """Return the modules of the functions that a declaration names: keys cover their source."""
    if declaration is None:
        return []
    references = [*declaration.costs.values(), declaration.succeeds, declaration.measured]
    modules = [where.module for where in references if where is not None and where.module]
    return list(dict.fromkeys(modules))
