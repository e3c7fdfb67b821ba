"""Calls into the code of others, which may fail in every way: each failure becomes one `TaskError` that names the environment."""

from __future__ import annotations

import math
import numbers
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, described

GymEnv = gymnasium.Env[Any, Any]

COST_HINT = "its step has to return info['cost']: a number for every env step, 0 where nothing went wrong"
_A_COST = "a cost is a finite number of at least 0"
LONE_SOURCE = "cost"  # the cost source of an environment that names none
_SUM = "cost_sum"


class EnvStep(NamedTuple):
    """What an env step returned, checked."""

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
    """Let every expected error of the block name the environment, and turn every other failure into an expected one."""
    try:
        with calling("code"):
            yield
    except TaskError as error:
        raise TaskError(f"environment '{name}': {error.message}", error.hint) from error


@contextmanager
def calling(part: str) -> Iterator[None]:
    """Call code of another in the block, which must neither end this process nor print its traceback."""
    try:
        yield
    except TaskError:
        raise
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        raise TaskError(
            f"its {part} failed: {described(error)}", f"in {Path(frames[-1].filename).name}, line {frames[-1].lineno}"
        ) from error


def reset(env: GymEnv, seed: int) -> Any:
    """Start an episode and return what is seen."""
    with calling("reset"):
        returned = env.reset(seed=seed)
    seen, _ = _values("reset", returned, "(observation, info)", 2)
    return seen


def step(env: GymEnv, action: NDArray[Any]) -> EnvStep:
    """Advance by an env step under `action`, of the shape of the environment's action space."""
    with calling("step"):
        returned = env.step(action)
    seen, reward, terminated, truncated, info = _values("step", returned, "(observation, reward, terminated, truncated, info)", 5)
    if "cost" not in info:
        raise TaskError("its info has no 'cost'", COST_HINT)
    reward = _finite("its step gave a reward of", reward, "a reward is a finite number")
    cost = _finite("info['cost'] is", info["cost"], _A_COST, least=0.0)
    goals = None
    if "goals" in info:
        goals = _finite("info['goals'] is", info["goals"], "the number of goals reached so far in the episode", least=0.0, whole=True)
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
    """What a call returned, of which the last value has to be an info."""
    if not isinstance(returned, tuple) or len(returned) != size:
        got = f"{len(returned)} values" if isinstance(returned, tuple) else f"a single {type(returned).__name__}"
        raise TaskError(f"its {part} returned {got}", f"gymnasium's {part} returns {size}: {form}")
    if not isinstance(returned[-1], Mapping):
        raise TaskError(f"its {part} returned {_shown(returned[-1])} as info", "info is a dictionary; " + COST_HINT)
    return returned


def _sources(info: Mapping[str, Any], cost: float) -> dict[str, float]:
    # Safety-Gymnasium tells its costs flat: `cost_<source>` beside `cost_sum`.
    flat = {key.removeprefix("cost_"): value for key, value in info.items() if str(key).startswith("cost_") and key != _SUM}
    sources: Any = info.get("cost_sources", (flat if _SUM in info else {}) or {LONE_SOURCE: cost})
    if not (isinstance(sources, Mapping) and sources and all(isinstance(source, str) for source in sources)):
        raise TaskError(f"info['cost_sources'] is {_shown(sources)}", "a dictionary from names to costs, with every source in every step")
    return {source: _finite(f"info['cost_sources']['{source}'] is", value, _A_COST) for source, value in sources.items()}


def _finite(said: str, value: Any, hint: str, least: float = -math.inf, whole: bool = False) -> float:
    number = _number(value)
    if number is None or not math.isfinite(number) or number < least or (whole and number != int(number)):
        raise TaskError(f"{said} {_shown(value)}", hint)
    return number


def _flag(name: str, value: Any) -> bool:
    number = _number(value)
    if number is None:
        raise TaskError(f"its step gave {name} = {_shown(value)}", "it is True or False")
    return bool(number)


def _number(value: Any) -> float | None:
    """A real number, a bool, or an array of no axes that holds one; None for everything else, texts of digits too."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    return float(value) if isinstance(value, numbers.Real | np.bool_) else None


def _shown(value: Any) -> str:
    number = _number(value)
    text = f"{number:g}" if number is not None and not isinstance(value, bool | np.bool_) else " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
