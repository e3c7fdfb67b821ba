"""What a foreign environment says of itself, and whether it has what a task needs: it is made and stepped once when a spec is read."""

from __future__ import annotations

import contextlib
import copy
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UnknownName, WaspError, described
from wasp_cli.registry import import_here
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.foreign.calls import GymEnv, calling, of_environment, reset, step
from wasp_cli.tasks.foreign.views import Views, views_of


@dataclass(frozen=True)
class Facts:
    """What a task has to know of an environment."""

    modules: tuple[str, ...]  # where its code begins
    registered: str  # how it is registered, as text: the options that it is made with decide its results
    env_steps: int  # time limit in env steps
    env_seconds: float  # time of one env step in seconds
    success_goals: int  # goals that count as success
    cost_sources: tuple[str, ...]
    action_low: Floats  # [A]
    action_high: Floats  # [A]
    views: Views


def examine(name: str, tasks: Iterable[str] = ()) -> Facts:
    """Make the environment `name` once per process, drive it for a step, and return what it says of itself.

    Args:
        name: `module:Id-v0`, or an id that is registered already.
        tasks: what else `name` could stand for, to be suggested where there is no such id.
    """
    # What modules and environments print as they start must not get between the lines of a plan that is JSON.
    with contextlib.redirect_stdout(sys.stderr):
        find_spec(name, tasks)
        return _examined(name)


@cache
def _examined(name: str) -> Facts:
    spec = find_spec(name)
    env = make_env(name)
    try:
        with of_environment(name):
            limit = _env_steps(spec, env)
            low, high = _bounds(env)
            views = views_of(env.observation_space)
            sources = _try_step(env, views)
            points = [spec.entry_point, *(wrapper.entry_point for wrapper in spec.additional_wrappers)]
            modules = dict.fromkeys(filter(None, [name.rpartition(":")[0], *map(_entry_module, points)]))
            registered = f"{sorted(spec.kwargs.items())} {[(wrapper.entry_point, wrapper.kwargs) for wrapper in spec.additional_wrappers]}"
            seconds, success = _env_seconds(env), _success_goals(env)
            return Facts(tuple(modules), registered, limit, seconds, success, sources, low.ravel(), high.ravel(), views)
    finally:
        with contextlib.suppress(TaskError), calling("close"):  # nothing is asked of it any more
            env.close()


def find_spec(name: str, tasks: Iterable[str] = ()) -> EnvSpec:
    """Return the registration of an id; the module before the colon is imported first, and registers it.

    Args:
        name: as for `examine`.
        tasks: as for `examine`.
    """
    module, _, gym_id = name.rpartition(":")
    before = set(gymnasium.registry)
    if module:
        try:
            import_here(module)
        except WaspError as error:
            raise TaskError(error.message, error.hint) from error
    try:
        return gymnasium.spec(gym_id)
    except gymnasium.error.Error as error:
        # The ids of that module are the ones that can be meant.
        own = [known for known, spec in gymnasium.registry.items() if known not in before or _entry_module(spec.entry_point) == module]
        if module:
            example = f"gymnasium.register('{gym_id}', entry_point=..., max_episode_steps=...)"
            message = f"module '{module}' registers no '{gym_id}'"
            # Of few ids all are worth naming; a module without any is told how to register one.
            otherwise = None if own else f"write {example} in it"
            raise UnknownName("gymnasium id", gym_id, own, message=message, otherwise=otherwise) from error
        known = {*tasks, *gymnasium.registry}
        message = f"no task and no gymnasium id is called '{gym_id}'"
        otherwise = f"write module:{gym_id} for an id that a module of yours registers"
        raise UnknownName("gymnasium id", gym_id, known, message=message, otherwise=otherwise) from error


def make_env(name: str) -> GymEnv:
    """Make one environment without gymnasium's own time limit and checks, which the task replaces."""
    spec = copy.deepcopy(find_spec(name))
    spec.max_episode_steps, spec.order_enforce, spec.disable_env_checker = None, False, True
    try:
        env: GymEnv = gymnasium.make(spec)
    except (Exception, SystemExit) as error:  # the code is another's
        raise TaskError(f"environment '{name}' cannot be made: {described(error)}") from error
    return env


# -- what is looked at -----------------------------------------------------------------------------------------------------------------


def _entry_module(entry_point: Any) -> str:
    return entry_point.partition(":")[0] if isinstance(entry_point, str) else str(getattr(entry_point, "__module__", ""))


def _env_steps(spec: EnvSpec, env: GymEnv) -> int:
    own = getattr(env.unwrapped, "max_episode_steps", None)
    limit = spec.max_episode_steps if spec.max_episode_steps is not None else own
    if not isinstance(limit, int) or limit < 1:
        raise TaskError("it has no time limit", f"register it with one: gymnasium.register('{spec.id}', ..., max_episode_steps=500)")
    return limit


def _env_seconds(env: GymEnv) -> float:
    rate = env.unwrapped.metadata.get("render_fps")
    seconds = 1.0 / rate if isinstance(rate, int | float) and rate > 0 else getattr(env.unwrapped, "dt", None)
    if not isinstance(seconds, int | float) or not seconds > 0:
        hint = "metadata = {'render_fps': 10} says that ten env steps are a second, which operators with a reaction time need"
        raise TaskError("it does not say how long an env step is", hint)
    return float(seconds)


def _bounds(env: GymEnv) -> tuple[Floats, Floats]:
    space = env.action_space
    if not isinstance(space, gymnasium.spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise TaskError(f"its action space is {space}", "an operator's commands are continuous: a float Box with finite bounds")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if not (space.shape and np.prod(space.shape) and np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise TaskError(f"its action space is {space}", "every action needs a finite lower bound and a finite upper bound above it")
    return low, high


def _success_goals(env: GymEnv) -> int:
    goals = env.unwrapped.metadata.get("success_goals", 1)
    if not isinstance(goals, int) or goals < 1:
        raise TaskError(f"its metadata['success_goals'] is {goals!r}", "the number of goals within the time limit that count as success")
    return goals


def _try_step(env: GymEnv, views: Views) -> tuple[str, ...]:
    """One step of two equal episodes.

    Returns:
        The cost sources.
    """
    middle = (env.action_space.low + env.action_space.high) / 2  # type: ignore[attr-defined]  # a Box, as `_bounds` has seen
    first = reset(env, 0)
    views.check(first)
    done = step(env, middle.astype(env.action_space.dtype))
    views.check(done.seen)
    again = reset(env, 0)
    views.check(again)
    if not _same(first, again):
        hint = "draw everything from self.np_random, after super().reset(seed=seed): assistants are compared on the same worlds"
        raise TaskError("two resets with the same seed show different things", hint)
    return tuple(done.sources)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(_same(value, other[name]) for name, value in one.items())
    left: NDArray[Any] = np.asarray(one)
    return left.tobytes() == np.asarray(other).tobytes()
