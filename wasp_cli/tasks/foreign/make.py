"""Making one foreign environment, with what its declaration says and with snapshots."""

from __future__ import annotations

import copy
import inspect
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.error import DependencyNotInstalled

from wasp_cli.errors import TaskError, described
from wasp_cli.tasks.declared import RENDER, Declaration, DeclarationError, declaration_of
from wasp_cli.tasks.foreign.calls import GymEnv, of_environment
from wasp_cli.tasks.foreign.closing import close
from wasp_cli.tasks.foreign.layers import env_steps
from wasp_cli.tasks.foreign.lookup import registration_of
from wasp_cli.tasks.foreign.replayed import with_snapshots
from wasp_cli.tasks.foreign.translated import translated


@contextmanager
def made(name: str, renders: bool = False) -> Iterator[GymEnv]:
    """Make an environment for the block, and close it at the end; arguments as of `make_env`."""
    env = make_env(name, renders)
    try:
        yield env
    finally:
        close(name, env)


def make_env(name: str, renders: bool = False, draws: bool = False) -> GymEnv:
    """Make one environment without gymnasium's own time limit and checks, which the task
    replaces. Its info has cost and success as `calls.step` reads them, and it has `snapshot` and
    `restore`.

    Args:
        name: of the task.
        renders: whether its image is read; where `render()` draws it, drawing costs time.
        draws: whether `render()` is called, whatever assistants see.

    Raises:
        TaskError: it cannot be made.
    """
    spec = copy.copy(registration_of(name))
    registered = spec.max_episode_steps
    declaration = declaration_of(name)
    arguments: dict[str, Any] = {}
    if declaration is not None:
        arguments = dict(declaration.make)
        draws |= renders and declaration.image == RENDER
    if draws:
        arguments.setdefault("render_mode", "rgb_array")
    spec.max_episode_steps = None
    spec.order_enforce = False
    spec.disable_env_checker = True
    try:
        with warnings.catch_warnings():
            # gymnasium says in a warning that a render mode is not among those of the metadata
            warnings.simplefilter("ignore")
            env: GymEnv = gymnasium.make(spec, **arguments)
    except (Exception, SystemExit) as error:  # the code is another's
        raise _not_made(name, spec, error, declaration) from error
    if declaration is not None:
        with of_environment(name):
            env = translated(env, declaration)
    limit = None if declaration is None else declaration.limit
    return with_snapshots(env, env_steps(env, limit or registered) or 0)


def _not_made(
    name: str, spec: EnvSpec, error: BaseException, declaration: Declaration | None
) -> TaskError:
    """The error of an environment that cannot be made, with the line of its declaration that may
    be wrong.
    """
    message = f"environment '{name}' cannot be made: {described(error)}"
    if isinstance(error, ImportError | DependencyNotInstalled):
        hint = "install what it needs, and run this command again"
        if declaration is None:
            return TaskError(message, hint)
        return DeclarationError("id", message, hint)
    if declaration is None:
        return TaskError(message)
    if isinstance(error, TypeError) and "render_mode" in str(error):
        hint = "it does not draw itself: leave `image: render` out"
        return DeclarationError("image", message, hint)
    if declaration.make:
        taken = ", ".join(_arguments(spec)) or "no arguments that are known"
        return DeclarationError("make", message, f"`make` has arguments of it; it takes {taken}")
    return DeclarationError("id", message)


def _arguments(spec: EnvSpec) -> list[str]:
    """The names of the arguments that an environment is made with, as far as they are known."""
    point = spec.entry_point
    try:
        creator = load_env_creator(point) if isinstance(point, str) else point
        parameters = inspect.signature(creator).parameters if creator is not None else {}
    except (Exception, SystemExit):  # the code is another's
        return []
    return [name for name in parameters if name not in ("self", "args", "kwargs", "render_mode")]
