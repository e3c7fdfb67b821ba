"""What a foreign environment says of itself, in whichever of its wrappers.

An environment is a stack of layers: wrappers, the outermost first, and the environment within.
A wrapper changes what the layers below it do: one that repeats actions changes the time of a step,
one that ends episodes changes their limit. So the outermost layer that has a value counts.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np

_ABSENT = object()
TIME_LIMITS = ("max_episode_steps", "_max_episode_steps")
"""Attributes that hold a limit in env steps; the second is that of gymnasium's `TimeLimit`."""


def layers(env: gymnasium.Env[Any, Any]) -> Iterator[gymnasium.Env[Any, Any]]:
    """Yield every wrapper of an environment, the outermost first, and the environment itself."""
    yield env
    while isinstance(env, gymnasium.Wrapper):
        env = env.env
        yield env


def attribute(env: gymnasium.Env[Any, Any], name: str) -> Any:
    """Return an attribute of the outermost layer that has one that is not None, or None."""
    for layer in layers(env):
        value = of_layer(layer, name)
        if value is not None:
            return value
    return None


def from_metadata(env: gymnasium.Env[Any, Any], name: str) -> Any:
    """Return an entry of `metadata` of the outermost layer that has one, or None."""
    for layer in layers(env):
        value = _metadata(layer).get(name)
        if value is not None:
            return value
    return None


def env_seconds(env: gymnasium.Env[Any, Any]) -> float | None:
    """Return the time of an env step in seconds, from `metadata["render_fps"]` or `dt`.

    Where one layer has both, the frame rate counts. None where no layer has a number above 0.
    """
    for layer in layers(env):
        rate = as_number(_metadata(layer).get("render_fps"))
        if rate is not None and rate > 0:
            return 1.0 / rate
        # A wrapper without a rate of its own has that of the layer below it, which comes next.
        seconds = as_number(of_layer(layer, "dt"))
        if seconds is not None and seconds > 0:
            return seconds
    return None


def env_steps(env: gymnasium.Env[Any, Any], registered: object) -> int | None:
    """Return the number of env steps after which every episode has ended: the least of all limits.

    Args:
        env: an environment without the time limit of its registration.
        registered: `max_episode_steps` of its registration, or None.

    Returns:
        None where neither the registration nor a layer has a limit; a layer may be gymnasium's
        `TimeLimit`, or have an attribute `max_episode_steps`.
    """
    stated = [registered]
    for layer in layers(env):
        stated += [of_layer(layer, name) for name in TIME_LIMITS]
    limits = [limit for limit in map(as_whole, stated) if limit is not None and limit >= 1]
    return min(limits, default=None)


def of_layer(layer: gymnasium.Env[Any, Any], name: str) -> Any:
    """Return an attribute of one layer, or None. A property that fails counts as absent."""
    try:
        return getattr(layer, name, None)
    except Exception:  # the code is another's
        return None


def as_number(value: object) -> float | None:
    """Return a real number as a float: Python's, NumPy's, or an array that holds a single one.

    None for everything else: a text of digits, a bool, an array of several numbers.
    """
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Real):
        return None
    return float(value)


def as_whole(value: object) -> int | None:
    """Return a whole number as an int, as `as_number` reads it; None for everything else."""
    number = as_number(value)
    return int(number) if number is not None and number == int(number) else None


def _metadata(layer: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """The metadata of one layer; nothing where a wrapper only passes on that of the layer below."""
    metadata = of_layer(layer, "metadata")
    if isinstance(layer, gymnasium.Wrapper) and metadata is of_layer(layer.env, "metadata"):
        return {}
    return metadata if isinstance(metadata, dict) else {}
