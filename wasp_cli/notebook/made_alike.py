"""Whether an environment was made with the arguments that its assistant was trained with."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator

from wasp_cli.errors import UsageError
from wasp_cli.tasks.declared import declaration_of
from wasp_cli.tasks.foreign.lookup import registered_as

IGNORED = ("render_mode",)  # changes no episode


def require_made_alike(env: gymnasium.Env[Any, Any], task: str, label: str) -> None:
    """Refuse an environment of somebody else's that was made with other arguments than in training.

    Only what can be seen is compared: arguments that gymnasium recorded, and defaults of the
    environment's class. An environment that gymnasium did not make, or with another id, passes.

    Raises:
        UsageError: the arguments differ; it names them.
    """
    here = env.unwrapped.spec
    _, _, trained_id = registered_as(task).rpartition(":")
    if here is None or here.id != trained_id or trained_id not in gymnasium.registry:
        return
    registered = gymnasium.spec(trained_id)
    declaration = declaration_of(task)
    declared = {} if declaration is None else declaration.make
    defaults = _defaults(registered)
    trained = {**defaults, **registered.kwargs, **declared}
    made = {**defaults, **here.kwargs}
    names = [name for name in trained if name in made and name not in IGNORED]
    differing = [name for name in names if not _same(trained[name], made[name])]
    if not differing:
        return
    found = ", ".join(f"{name}={made[name]!r}" for name in differing)
    wanted = ", ".join(f"{name}={trained[name]!r}" for name in differing)
    raise UsageError(
        f"the environment was made with {found}, and '{label}' was trained with {wanted}",
        f"gymnasium.make('{here.id}', {wanted})",
    )


def _defaults(spec: EnvSpec) -> Mapping[str, Any]:
    """The arguments of an environment for which none are given, as far as they are known."""
    point = spec.entry_point
    try:
        creator = load_env_creator(point) if isinstance(point, str) else point
        parameters = inspect.signature(creator).parameters if creator is not None else {}
    except Exception:  # the code is another's
        return {}
    return {
        name: parameter.default
        for name, parameter in parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }


def _same(one: Any, other: Any) -> bool:
    """Whether two arguments are equal; those that cannot be compared count as equal."""
    try:
        return bool(_plain(one) == _plain(other))
    except Exception:  # the code is another's
        return True


def _plain(value: Any) -> Any:
    """An argument as a spec may have it: lists in place of tuples and arrays."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    return value
