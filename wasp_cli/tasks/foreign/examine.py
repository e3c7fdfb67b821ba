"""Calls into the code of others, and what a foreign environment says of itself: it is made and
stepped once when a spec is read.

A call may fail in every way: each failure becomes one `TaskError` that names the environment.
"""

from __future__ import annotations

import contextlib
import copy
import math
import numbers
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UnknownName, WaspError, described
from wasp_cli.registry import import_here
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.foreign.closing import close
from wasp_cli.tasks.foreign.started import mark
from wasp_cli.tasks.foreign.views import Views, views_of

GymEnv = gymnasium.Env[Any, Any]

COST_HINT = (
    "its step has to return info['cost']: a number for every env step, 0 where nothing went wrong"
)
_A_COST = "a cost is a finite number of at least 0"
LONE_SOURCE = "cost"  # the cost source of an environment that names none
_SUM = "cost_sum"


class EnvStep(NamedTuple):
    seen: Any
    reward: float
    terminated: bool
    truncated: bool
    cost: float
    sources: dict[str, float]  # cost by source
    goals: int | None  # reached so far; None where the environment does not count them
    success: bool


@contextmanager
def of_environment(name: str) -> Iterator[None]:
    """Let every expected error of the block name the environment, and turn every other failure
    into an expected one.
    """
    try:
        with calling("code"):
            yield
    except TaskError as error:
        raise TaskError(f"environment '{name}': {error.message}", error.hint) from error


@contextmanager
def calling(part: str) -> Iterator[None]:
    """Call code of another in the block, which must neither end this process nor print its
    traceback.
    """
    try:
        yield
    except TaskError:
        raise
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        raise TaskError(
            f"its {part} failed: {described(error)}",
            f"in {Path(frames[-1].filename).name}, line {frames[-1].lineno}",
        ) from error


def reset(env: GymEnv, seed: int) -> Any:
    with calling("reset"):
        returned = env.reset(seed=seed)
    seen, _ = _values("reset", returned, "(observation, info)", 2)
    return seen


def step(env: GymEnv, action: NDArray[Any]) -> EnvStep:
    """Advance by an env step under `action`, of the shape of the environment's action space."""
    with calling("step"):
        returned = env.step(action)
    seen, reward, terminated, truncated, info = _values(
        "step", returned, "(observation, reward, terminated, truncated, info)", 5
    )
    if "cost" not in info:
        raise TaskError("its info has no 'cost'", COST_HINT)
    reward = _finite("its step gave a reward of", reward, "a reward is a finite number")
    cost = _finite("info['cost'] is", info["cost"], _A_COST, least=0.0)
    goals = None
    if "goals" in info:
        goals = _finite(
            "info['goals'] is",
            info["goals"],
            "the number of goals reached so far in the episode",
            least=0.0,
            whole=True,
        )
    return EnvStep(
        seen,
        reward,
        _flag("terminated", terminated),
        _flag("truncated", truncated),
        cost,
        _sources(info, cost),
        None if goals is None else int(goals),
        _flag("info['success']", info.get("success", False)),
    )


def _values(part: str, returned: Any, form: str, size: int) -> tuple[Any, ...]:
    if not isinstance(returned, tuple) or len(returned) != size:
        got = (
            f"{len(returned)} values"
            if isinstance(returned, tuple)
            else f"a single {type(returned).__name__}"
        )
        raise TaskError(f"its {part} returned {got}", f"gymnasium's {part} returns {size}: {form}")
    if not isinstance(returned[-1], Mapping):
        raise TaskError(
            f"its {part} returned {_shown(returned[-1])} as info",
            "info is a dictionary; " + COST_HINT,
        )
    return returned


def _sources(info: Mapping[str, Any], cost: float) -> dict[str, float]:
    # Safety-Gymnasium tells its costs flat: `cost_<source>` beside `cost_sum`.
    flat = {
        key.removeprefix("cost_"): value
        for key, value in info.items()
        if str(key).startswith("cost_") and key != _SUM
    }
    sources: Any = info.get("cost_sources", (flat if _SUM in info else {}) or {LONE_SOURCE: cost})
    if not (
        isinstance(sources, Mapping)
        and sources
        and all(isinstance(source, str) for source in sources)
    ):
        raise TaskError(
            f"info['cost_sources'] is {_shown(sources)}",
            "a dictionary from names to costs, with every source in every step",
        )
    return {
        source: _finite(f"info['cost_sources']['{source}'] is", value, _A_COST)
        for source, value in sources.items()
    }


def _finite(
    said: str, value: Any, hint: str, least: float = -math.inf, whole: bool = False
) -> float:
    number = _number(value)
    if (
        number is None
        or not math.isfinite(number)
        or number < least
        or (whole and number != int(number))
    ):
        raise TaskError(f"{said} {_shown(value)}", hint)
    return number


def _flag(name: str, value: Any) -> bool:
    number = _number(value)
    if number is None:
        raise TaskError(f"its step gave {name} = {_shown(value)}", "it is True or False")
    return bool(number)


def _number(value: Any) -> float | None:
    """A real number, a bool, or an array of no axes that holds one; None for everything else,
    texts of digits too.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    return float(value) if isinstance(value, numbers.Real | np.bool_) else None


def _shown(value: Any) -> str:
    number = _number(value)
    text = (
        f"{number:g}"
        if number is not None and not isinstance(value, bool | np.bool_)
        else " ".join(repr(value).split())
    )
    return text if len(text) <= 60 else text[:57] + "..."


@dataclass(frozen=True)
class Facts:
    modules: tuple[str, ...]  # where its code begins
    # how it is registered, as text: the options that it is made with decide its results
    registered: str
    env_steps: int  # time limit in env steps
    env_seconds: float  # time of one env step in seconds
    success_goals: int  # goals that count as success
    cost_sources: tuple[str, ...]
    action_low: Floats  # [A]
    action_high: Floats  # [A]
    views: Views


def examine(name: str, tasks: Iterable[str] = ()) -> Facts:
    """Make the environment `name` (`module:Id-v0`, or a registered id) once per process;
    `tasks` are for suggestions.
    """
    # What modules and environments print as they start must not get between the lines of a plan
    # that is JSON.
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
            points = [
                spec.entry_point,
                *(wrapper.entry_point for wrapper in spec.additional_wrappers),
            ]
            modules = dict.fromkeys(
                filter(None, [name.rpartition(":")[0], *map(_entry_module, points)])
            )
            registered = (
                f"{sorted(spec.kwargs.items())} "
                f"{[(wrapper.entry_point, wrapper.kwargs) for wrapper in spec.additional_wrappers]}"
            )
            seconds, success = _env_seconds(env), _success_goals(env)
            return Facts(
                tuple(modules),
                registered,
                limit,
                seconds,
                success,
                sources,
                low.ravel(),
                high.ravel(),
                views,
            )
    finally:
        close(name, env)


def find_spec(name: str, tasks: Iterable[str] = ()) -> EnvSpec:
    """Return the registration of an id; the module before the colon is imported first, and
    registers it.
    """
    mark()  # what the module starts as it is imported, too
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
        own = [
            known
            for known, spec in gymnasium.registry.items()
            if known not in before or _entry_module(spec.entry_point) == module
        ]
        if module:
            example = f"gymnasium.register('{gym_id}', entry_point=..., max_episode_steps=...)"
            message = f"module '{module}' registers no '{gym_id}'"
            # Of few ids all are worth naming; a module without any is told how to register one.
            otherwise = None if own else f"write {example} in it"
            raise UnknownName(
                "gymnasium id", gym_id, own, message=message, otherwise=otherwise
            ) from error
        known = {*tasks, *gymnasium.registry}
        message = f"no task and no gymnasium id is called '{gym_id}'"
        otherwise = f"write module:{gym_id} for an id that a module of yours registers"
        raise UnknownName(
            "gymnasium id", gym_id, known, message=message, otherwise=otherwise
        ) from error


def make_env(name: str) -> GymEnv:
    """Make one environment without gymnasium's own time limit and checks, which the task
    replaces.
    """
    spec = copy.deepcopy(find_spec(name))
    spec.max_episode_steps, spec.order_enforce, spec.disable_env_checker = None, False, True
    try:
        env: GymEnv = gymnasium.make(spec)
    except (Exception, SystemExit) as error:  # the code is another's
        raise TaskError(f"environment '{name}' cannot be made: {described(error)}") from error
    return env


# -- what is looked at -----------------------------------------------------------------------------


def _entry_module(entry_point: Any) -> str:
    return (
        entry_point.partition(":")[0]
        if isinstance(entry_point, str)
        else str(getattr(entry_point, "__module__", ""))
    )


def _env_steps(spec: EnvSpec, env: GymEnv) -> int:
    own = getattr(env.unwrapped, "max_episode_steps", None)
    limit = spec.max_episode_steps if spec.max_episode_steps is not None else own
    if not isinstance(limit, int) or limit < 1:
        raise TaskError(
            "it has no time limit",
            f"register it with one: gymnasium.register('{spec.id}', ..., max_episode_steps=500)",
        )
    return limit


def _env_seconds(env: GymEnv) -> float:
    rate = env.unwrapped.metadata.get("render_fps")
    seconds = (
        1.0 / rate
        if isinstance(rate, int | float) and rate > 0
        else getattr(env.unwrapped, "dt", None)
    )
    if not isinstance(seconds, int | float) or not seconds > 0:
        hint = (
            "metadata = {'render_fps': 10} says that ten env steps are a second, which "
            "operators with a reaction time need"
        )
        raise TaskError("it does not say how long an env step is", hint)
    return float(seconds)


def _bounds(env: GymEnv) -> tuple[Floats, Floats]:
    space = env.action_space
    if not isinstance(space, gymnasium.spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise TaskError(
            f"its action space is {space}",
            "an operator's commands are continuous: a float Box with finite bounds",
        )
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if not (
        space.shape
        and np.prod(space.shape)
        and np.isfinite(low).all()
        and np.isfinite(high).all()
        and (low < high).all()
    ):
        raise TaskError(
            f"its action space is {space}",
            "every action needs a finite lower bound and a finite upper bound above it",
        )
    return low, high


def _success_goals(env: GymEnv) -> int:
    goals = env.unwrapped.metadata.get("success_goals", 1)
    if not isinstance(goals, int) or goals < 1:
        raise TaskError(
            f"its metadata['success_goals'] is {goals!r}",
            "the number of goals within the time limit that count as success",
        )
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
        hint = (
            "draw everything from self.np_random, after super().reset(seed=seed): assistants "
            "are compared on the same worlds"
        )
        raise TaskError("two resets with the same seed show different things", hint)
    return tuple(done.sources)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(
            _same(value, other[name]) for name, value in one.items()
        )
    left: NDArray[Any] = np.asarray(one)
    return left.tobytes() == np.asarray(other).tobytes()
