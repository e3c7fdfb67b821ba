"""Where a foreign environment is registered: its module is imported, and its id looked up."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from wasp_cli.errors import TaskError, UnknownName, WaspError, did_you_mean
from wasp_cli.registry import import_here, remedy
from wasp_cli.tasks.declared import declaration_of
from wasp_cli.tasks.foreign.started import mark
from wasp_cli.tasks.foreign.surroundings import go_headless


def registered_as(name: str) -> str:
    """Return the gymnasium id of a task, with its module: its own name, or what is declared."""
    declaration = declaration_of(name)
    return name if declaration is None else declaration.id


def registration_of(name: str, tasks: Iterable[str] = ()) -> EnvSpec:
    """Return how a task is registered with gymnasium. The module before the colon of its id is
    imported first, and registers it.

    Args:
        name: of the task.
        tasks: further names that are suggested where there is no such id.

    Raises:
        TaskError: the module cannot be imported.
        UnknownName: no such id is registered.
    """
    go_headless()
    mark()  # what the module starts as it is imported, too
    module, _, gym_id = registered_as(name).rpartition(":")
    before = set(gymnasium.registry)
    if module:
        try:
            import_here(module)
        except WaspError as error:
            raise TaskError(error.message, error.hint) from error
    try:
        return gymnasium.spec(gym_id)
    except gymnasium.error.Error as error:
        if module:
            # The ids of that module are the ones that can be meant.
            own = [
                registered_id
                for registered_id, spec in gymnasium.registry.items()
                if registered_id not in before or entry_module(spec.entry_point) == module
            ]
            raise UnknownName(
                "gymnasium id",
                gym_id,
                (),
                message=f"module '{module}' registers no '{gym_id}'",
                otherwise=remedy(module, _registering(module, gym_id, own)),
            ) from error
        raise UnknownName(
            "gymnasium id",
            gym_id,
            {*tasks, *gymnasium.registry},
            message=f"no task and no gymnasium id is called '{gym_id}'",
            otherwise=f"write module:{gym_id} for an id that a module of yours registers",
        ) from error


def _registering(module: str, gym_id: str, own: Sequence[str]) -> str:
    """What to write instead of an id that `module` does not register; `own` are those that it
    registers.
    """
    env_class = getattr(sys.modules[module], gym_id, None)
    if isinstance(env_class, type):  # the class was named, not the id under which it is registered
        for registered_id in own:
            if gymnasium.spec(registered_id).entry_point in (env_class, f"{module}:{gym_id}"):
                return f"write '{module}:{registered_id}'"
        example = f"gymnasium.register('{gym_id}-v0', entry_point={gym_id}, max_episode_steps=...)"
        return f"write {example} in it, and '{module}:{gym_id}-v0' here"
    example = f"gymnasium.register('{gym_id}', entry_point=..., max_episode_steps=...)"
    # Of few ids all are worth naming; a module without any is told how to register one.
    listed = "known: " + ", ".join(f"'{registered_id}'" for registered_id in own)
    hint = did_you_mean(gym_id, own, listed if own else f"write {example} in it")
    return hint.replace(" '", f" '{module}:") if own else hint


def entry_module(entry_point: Any) -> str:
    """Return the module of an entry point, which is an import string, a class or a function."""
    if isinstance(entry_point, str):
        return entry_point.partition(":")[0]
    return str(getattr(entry_point, "__module__", ""))
