"""What an environment is by itself, before anything is asked of it: its spaces, and the entries of
its `info` as they were met. That helps to say where its cost is.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from wasp_cli.tasks.foreign.calls import GymEnv, calling, five_values, number_of, of_environment
from wasp_cli.tasks.foreign.layers import env_seconds, env_steps, from_metadata
from wasp_cli.tasks.foreign.lookup import registration_of
from wasp_cli.tasks.foreign.make import made
from wasp_cli.tasks.foreign.surroundings import printing_aside

STEPS = 400  # env steps that are taken at most
SECONDS = 8.0  # that they may take
COSTS = re.compile(
    r"cost|crash|collision|collided|damage|unsafe|violat|off_?road|off_?track|"
    r"hazard|hurt|fell|lava",
    re.IGNORECASE,
)
"""Names of entries that may be a cost."""
SUCCESSES = re.compile(r"success|goal_reached|arrived|lap_finished|solved", re.IGNORECASE)
"""Names of entries that may be a success."""


@dataclass
class Entry:
    """An entry of `info`; `a.b` is the entry b of the dictionary a."""

    name: str
    kind: str  # its type
    least: float | None = None  # of numbers and bools
    most: float | None = None
    met: int = 0  # steps in which it was there


@dataclass
class Raw:
    """What was met in random steps."""

    observation: gymnasium.Space[Any]
    action: gymnasium.Space[Any]
    draws: bool  # whether it has the render mode rgb_array
    limit: int | None  # env steps
    seconds: float | None  # of an env step
    steps: int = 0
    ends: int = 0
    entries: dict[str, Entry] = field(default_factory=dict)

    def may_be(self, names: re.Pattern[str]) -> list[str]:
        """Return entries that are numbers of at least 0, are there in every step, and whose name
        contains one of `names`.
        """
        return [
            entry.name
            for entry in self.entries.values()
            if names.search(entry.name)
            and entry.met == self.steps
            and entry.least is not None
            and entry.least >= 0.0
        ]


def raw(name: str) -> Raw:
    """Take random steps in an environment, of any actions.

    Raises:
        TaskError: it cannot be made, or does not step.
    """
    with printing_aside(), made(name) as env, of_environment(name):
        survey = Raw(
            observation=env.observation_space,
            action=env.action_space,
            draws="rgb_array" in (from_metadata(env, "render_modes") or ()),
            limit=env_steps(env, registration_of(name).max_episode_steps),
            seconds=env_seconds(env),
        )
        _drive(env, survey)
        return survey


def _drive(env: GymEnv, survey: Raw) -> None:
    """Take random steps, and note what they return."""
    env.action_space.seed(0)
    end = time.perf_counter() + SECONDS
    seed = 0
    is_over = True
    length = 0
    while survey.steps < STEPS and time.perf_counter() < end:
        if is_over:
            with calling("reset"):
                env.reset(seed=seed)
            seed += 1
            length = 0
        with calling("step"):
            returned = env.step(env.action_space.sample())
        _, _, terminated, truncated, info = five_values(returned)
        survey.steps += 1
        length += 1
        _note("", info, survey.entries)
        is_over = bool(terminated) or bool(truncated) or length == survey.limit
        survey.ends += is_over


def _note(above: str, info: Mapping[Any, Any], entries: dict[str, Entry]) -> None:
    """Note the entries of an `info`, or of a dictionary in it, whose name begins with `above`."""
    for key, value in info.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping):
            _note(f"{name}.", value, entries)
            continue
        entry = entries.setdefault(name, Entry(name, _kind(value)))
        entry.met += 1
        number = number_of(value)
        if number is not None and np.isfinite(number):
            entry.least = number if entry.least is None else min(entry.least, number)
            entry.most = number if entry.most is None else max(entry.most, number)


def _kind(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {list(value.shape)}"
    return type(value).__name__
