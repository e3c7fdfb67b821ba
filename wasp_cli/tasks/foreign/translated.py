"""An environment whose `info` says cost and success under the names that WASP reads, whichever way
a declaration says they are found.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium

from wasp_cli.errors import WaspError
from wasp_cli.registry import import_here
from wasp_cli.tasks.declared import Declaration, DeclarationError
from wasp_cli.tasks.foreign.calls import GymEnv, calling, five_values, number_of, shown
from wasp_cli.tasks.references import Reference

Function = Callable[[GymEnv, Any, Mapping[str, Any]], Any]
"""Called as function(env, action, info): `action` is what the environment got, `info` what its step
returned."""
_KINDS = {"cost": "a finite number of at least 0", "success": "True or False"}


class Translated(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Every step tells `info["cost"]`, `info["cost_sources"]` and `info["success"]`, where the
    declaration says how; what it does not say stays as it is.
    """

    def __init__(self, env: GymEnv, declaration: Declaration) -> None:
        """Raises DeclarationError: a function of the declaration cannot be imported."""
        super().__init__(env)
        self._costs = {
            source: _Reading("cost", where) for source, where in declaration.costs.items()
        }
        succeeds = declaration.succeeds
        self._success = None if succeeds is None else _Reading("success", succeeds)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environment, and read its cost and its success."""
        seen, reward, terminated, truncated, info = five_values(self.env.step(action))
        told = dict(info)
        if self._costs:
            sources = {
                source: reading.value(self.env, action, info, terminated)
                for source, reading in self._costs.items()
            }
            told["cost_sources"] = sources
            told["cost"] = sum(sources.values())
        if self._success is not None:
            told.pop("goals", None)  # it would count instead
            told["success"] = self._success.value(self.env, action, info, terminated) > 0
        return seen, reward, terminated, truncated, told


class _Reading:
    """How one value of a step is read."""

    def __init__(self, field: str, where: Reference) -> None:
        self._field, self._where = field, where
        self._function = _imported(field, where) if where.module else None

    def value(self, env: GymEnv, action: Any, info: Mapping[str, Any], terminated: object) -> float:
        """Return the value of the step that was just taken.

        Raises:
            DeclarationError: there is none, or it is no number of the kind that is needed.
        """
        if self._function is not None:
            with calling(f"{self._field} function '{self._where.text}'"):
                found = self._function(env, action, info)
        elif self._where.of_end:
            found = terminated
        else:
            found = self._entry(info)
        number = number_of(found)
        if number is None or not math.isfinite(number) or number < 0.0:
            raise DeclarationError(
                self._field,
                f"{self._where.text} is {shown(found)}",
                f"a {self._field} is {_KINDS[self._field]}",
            )
        return number

    def _entry(self, info: Mapping[str, Any]) -> Any:
        found: Any = info
        for depth, name in enumerate(self._where.path):
            if not isinstance(found, Mapping) or name not in found:
                above = ".".join(("info", *self._where.path[:depth]))
                raise DeclarationError(
                    self._field,
                    f"there is no {self._where.text}: {above} {_holds(found)}",
                    "name one of them, or write module:function, which is called as "
                    "function(env, action, info)",
                )
            found = found[name]
        return found


def _holds(found: object) -> str:
    if not isinstance(found, Mapping):
        return f"is {shown(found)}"
    names = ", ".join(sorted(map(str, found)))
    return f"has {names[:200]}" if names else "is empty"


def _imported(field: str, where: Reference) -> Function:
    """Import the function that a reference names; its module may lie in the current folder."""
    try:
        import_here(where.module)
    except WaspError as error:
        raise DeclarationError(field, error.message, error.hint) from error
    function = getattr(importlib.import_module(where.module), where.function, None)
    if not callable(function):
        raise DeclarationError(
            field,
            f"module '{where.module}' has no function '{where.function}'",
            f"write in it: def {where.function}(env, action, info), which returns a number",
        )
    made: Function = function
    return made


def functions_of(declaration: Declaration | None) -> list[str]:
    """Return the modules of the functions that a declaration names: keys cover their source."""
    if declaration is None:
        return []
    references = [*declaration.costs.values(), declaration.succeeds]
    modules = [where.module for where in references if where is not None and where.module]
    return list(dict.fromkeys(modules))
