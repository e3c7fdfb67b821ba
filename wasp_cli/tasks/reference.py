"""The reference package's ids and options, so far as these tasks have them, and the list of what they do not have."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from wasp_cli.errors import UnknownName, UnknownOption, UsageError
from wasp_cli.tasks.registry import TASKS, task_named

MISSING = {
    "autoreset": "call reset, or step a vector (gymnasium.make_vec), which restarts by itself",
    "max_episode_steps": "an episode is as long as the task says; wrappers of gymnasium want five values, which ...Gymnasium-v0 gives",
    "camera_id": "there is one map for people, from above",
    "camera_name": "there is one map for people, from above; the robot's own cameras are observation='pixels' or 'vision'",
    "config": "a task is its level; add one of your own instead",
    "disable_env_checker": "gymnasium's checker wants five values, which ...Gymnasium-v0 gives",
    "apply_api_compatibility": "gymnasium 1.x has none",
}
"""Options of `safety_gymnasium.make` that `upstream` does not take, each with what stands for it."""
_FOR_FIVE_VALUES = ("max_episode_steps", "disable_env_checker")
"""Of these, what `gymnasium.make` takes where five values are given."""
MISSING_MODES = ("human", "human_list", "depth_array", "depth_array_list")
"""Render modes of the reference package that there are not: no window is opened, and a map has no depth."""

_SUFFIX = re.compile(r"(?P<name>.*?)(?P<vision>Vision)?(?P<five>Gymnasium)?(?P<debug>Debug)?(?P<version>-v\d+)")


class Known(NamedTuple):
    """An id of the reference package, taken apart."""

    task: str  # name of the task
    vision: bool  # its observation is a dictionary with the front image
    five_values: bool  # `step` returns gymnasium's five values


def parse_id(text: str) -> Known:
    """Read an id: `SafetyPointGoal1-v0`, `SafetyPointGoal1Vision-v0`, `SafetyPointGoal1Gymnasium-v0`, or both."""
    found = _SUFFIX.fullmatch(text)
    if found is None:
        return Known(_task(text, text), False, False)
    if found["debug"]:
        raise UsageError(f"there is no '{text}': its robot is driven with the keyboard", "leave 'Debug' out")
    return Known(_task(found["name"] + found["version"], text), bool(found["vision"]), bool(found["five"]))


def _task(text: str, asked: str) -> str:
    name = task_named(text)
    if name not in TASKS:  # somebody else's gymnasium id
        raise UnknownName("task", asked, [*TASKS, *(TASKS[known].gym_id for known in TASKS)])
    return name


def refuse_missing(known: Known, options: Mapping[str, Any]) -> None:
    """Refuse what the reference package has and these tasks have not."""
    for option in options:
        if option in MISSING and not (known.five_values and option in _FOR_FIVE_VALUES):
            words = f"upstream() got an unexpected keyword argument '{option}'"
            raise UnknownOption(f"{words}: task '{known.task}' has it not ({MISSING[option]})")
    if (mode := options.get("render_mode")) in MISSING_MODES:
        raise UsageError(f"task '{known.task}' cannot render '{mode}'", "render_mode is None or 'rgb_array', a map from above")
