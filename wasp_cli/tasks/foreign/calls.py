"""Calls into the code of others: what an environment returns is checked, and every failure becomes
a `TaskError` that names the environment.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, described
from wasp_cli.tasks.declared import DeclarationError
from wasp_cli.tasks.foreign.layers import as_number

GymEnv = gymnasium.Env[Any, Any]

COST_HINT = (
    "its step has to return info['cost']: a number for every env step, 0 where nothing went wrong; "
    "or say in the spec where the cost is, as in `tasks: [{id: ..., cost: info.crashed}]`"
)
LONE_SOURCE = "cost"
"""The cost source of an environment that names none."""
SUCCESS = ("success", "is_success")
"""Entries of `info` that say whether an episode succeeded; the second is that of
stable-baselines3.
"""
_A_COST = "a cost is a finite number of at least 0"
_SUM = "cost_sum"
_STEP = "(observation, reward, terminated, truncated, info)"
_HERE = Path(__file__).parent  # with the wrappers that call the environment for this module
_RESET = "def reset(self, *, seed=None, options=None), which returns (observation, info)"


class EnvStep(NamedTuple):
    """What one env step returned."""

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
    """Turn every failure of the block into a TaskError that names the environment. A
    DeclarationError stays one.
    """
    try:
        with calling("code"):
            yield
    except DeclarationError as error:
        message = f"environment '{name}': {error.message}"
        raise DeclarationError(error.field, message, error.hint) from error
    except TaskError as error:
        raise TaskError(f"environment '{name}': {error.message}", error.hint) from error


@contextmanager
def calling(part: str, hint: str | None = None) -> Iterator[None]:
    """Turn what code of others raises in the block, be it SystemExit, into a TaskError.

    Args:
        part: what is called, for the message.
        hint: how to write it, where the call itself failed, before any code of others ran.

    Raises:
        TaskError: the block raised anything else, or wanted to end the process.
    """
    try:
        yield
    except TaskError:
        raise
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        place = f"in {Path(frames[-1].filename).name}, line {frames[-1].lineno}"
        if hint is not None and Path(frames[-1].filename).parent == _HERE:
            place = f"write it as {hint}"
        raise TaskError(f"its {part} failed: {described(error)}", place) from error


def reset(env: GymEnv, seed: int) -> Any:
    """Begin the episode of a seed, and return its first observation. Raises TaskError."""
    with calling("reset", _RESET):
        returned = env.reset(seed=seed)
    seen, _ = _values("reset", returned, "(observation, info)", 2)
    return seen


def step(env: GymEnv, action: NDArray[Any]) -> EnvStep:
    """Advance by an env step under `action`, of the shape of the environment's action space.

    Raises:
        TaskError: the step failed, or what it returned lacks a cost or is not of gymnasium's form.
    """
    with calling("step"):
        returned = env.step(action)
    seen, reward, terminated, truncated, info = five_values(returned)
    if "cost" not in info:
        raise TaskError(f"its info has no 'cost'{_entries(info)}", COST_HINT)
    cost = _finite("info['cost'] is", info["cost"], _A_COST, least=0.0)
    return EnvStep(
        seen=seen,
        reward=_finite("its step gave a reward of", reward, "a reward is a finite number"),
        terminated=_flag("its step gave terminated", terminated),
        truncated=_flag("its step gave truncated", truncated),
        cost=cost,
        sources=_sources(info, cost),
        goals=_goals(info),
        success=_success(info),
    )


def five_values(returned: Any) -> tuple[Any, Any, Any, Any, Mapping[str, Any]]:
    """Return observation, reward, terminated, truncated and info of what a step returned.

    Safety-Gymnasium returns six: the cost stands after the reward, and is put into info.
    """
    if isinstance(returned, tuple) and len(returned) == 6:
        seen, reward, cost, terminated, truncated, info = returned
        if isinstance(info, Mapping):
            info = {"cost": cost, **info}
        returned = (seen, reward, terminated, truncated, info)
    seen, reward, terminated, truncated, info = _values("step", returned, _STEP, 5)
    return seen, reward, terminated, truncated, info


def _values(part: str, returned: Any, form: str, size: int) -> tuple[Any, ...]:
    """What `part` returned, after a check of its number of values and of its info."""
    if not isinstance(returned, tuple) or len(returned) != size:
        is_tuple = isinstance(returned, tuple)
        got = f"{len(returned)} values" if is_tuple else f"a single {type(returned).__name__}"
        raise TaskError(f"its {part} returned {got}", f"gymnasium's {part} returns {size}: {form}")
    if not isinstance(returned[-1], Mapping):
        message = f"its {part} returned {shown(returned[-1])} as info"
        raise TaskError(message, "info is a dictionary; " + COST_HINT)
    return returned


def _entries(info: Mapping[str, Any]) -> str:
    """The names in an info, for a message that says what is missing."""
    names = ", ".join(sorted(map(str, info)))
    return f", but {names[:200]}" if names else ""


def _goals(info: Mapping[str, Any]) -> int | None:
    if "goals" not in info:
        return None
    hint = "the number of goals reached so far in the episode"
    return int(_finite("info['goals'] is", info["goals"], hint, least=0.0, whole=True))


def _success(info: Mapping[str, Any]) -> bool:
    return any(_flag(f"info['{name}']", info[name]) for name in SUCCESS if name in info)


def _sources(info: Mapping[str, Any], cost: float) -> dict[str, float]:
    """The cost by source."""
    # Safety-Gymnasium has its costs side by side: `cost_<source>` beside `cost_sum`.
    flat = {
        key.removeprefix("cost_"): value
        for key, value in info.items()
        if str(key).startswith("cost_") and key != _SUM
    }
    if "cost_sources" in info:
        sources = info["cost_sources"]
    elif _SUM in info and flat:
        sources = flat
    else:
        sources = {LONE_SOURCE: cost}
    is_named = isinstance(sources, Mapping) and all(isinstance(name, str) for name in sources)
    if not is_named or not sources:
        raise TaskError(
            f"info['cost_sources'] is {shown(sources)}",
            "a dictionary from names to costs, with every source in every step",
        )
    return {
        source: _finite(f"info['cost_sources']['{source}'] is", value, _A_COST)
        for source, value in sources.items()
    }


def _finite(
    said: str, value: Any, hint: str, least: float = -math.inf, whole: bool = False
) -> float:
    """A value as a finite number of at least `least`; `said` begins the message of the error."""
    number = number_of(value)
    if number is None or not math.isfinite(number) or number < least:
        raise TaskError(f"{said} {shown(value)}", hint)
    if whole and number != int(number):
        raise TaskError(f"{said} {shown(value)}", hint)
    return number


def _flag(name: str, value: Any) -> bool:
    number = number_of(value)
    if number is None:
        raise TaskError(f"{name} = {shown(value)}", "it is True or False")
    return bool(number)


def number_of(value: Any) -> float | None:
    """Return a real number, a bool, or an array that holds a single one, as a float; None for
    everything else.
    """
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, bool | np.bool_):
        return float(value)
    return as_number(value)


def shown(value: Any) -> str:
    """Return a value as a short text, for messages."""
    number = as_number(value)
    text = f"{number:g}" if number is not None else " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
