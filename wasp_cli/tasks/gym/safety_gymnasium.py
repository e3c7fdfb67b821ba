"""The tasks under the ids and with the six values of Safety-Gymnasium, the reference package."""

from __future__ import annotations

import re
from typing import Any

import gymnasium
from numpy.typing import NDArray

from wasp_cli.errors import UnknownName, UnknownOption, UsageError
from wasp_cli.tasks.registry import TASKS, task_named

_ID = re.compile(
    r"(?P<name>.*?)(?P<vision>Vision)?(?P<five>Gymnasium)?(?P<debug>Debug)?(?P<version>-v\d+)"
)


def upstream(id: str, **options: Any) -> gymnasium.Env[Any, NDArray[Any]]:
    """Make a task that takes actions [A] and gives the reference package's six values: stands for
    `safety_gymnasium.make(id)`.

    `id` is `SafetyPointGoal1-v0`, with or without `wasp/`, or a name such as `goal1`.
    `...Vision-v0` is the same with `observation="vision"`, `...Gymnasium-v0` the same with
    gymnasium's five values. `options` are those of `TaskEnv`.

    Raises:
        UnknownName: there is no such task.
        UsageError: the id is one of the keyboard, or `render_mode` is not `rgb_array`.
        UnknownOption: an option is that of a wrapper, which needs five values.
    """
    parts = _ID.fullmatch(id)
    if parts is not None and parts["debug"]:
        raise UsageError(
            f"there is no '{id}': its robot is driven with the keyboard", "leave 'Debug' out"
        )
    task = task_named(id if parts is None else parts["name"] + parts["version"])
    if task not in TASKS:  # somebody else's gymnasium id
        raise UnknownName("task", id, [*TASKS, *(TASKS[name].gym_id for name in TASKS)])
    five_values = bool(parts and parts["five"])
    for option in {"max_episode_steps", "disable_env_checker"} & options.keys():
        if not five_values:
            words = f"upstream() got an unexpected keyword argument '{option}'"
            raise UnknownOption(
                f"{words}: gymnasium's wrappers want five values, which ...Gymnasium-v0 gives"
            )
    mode = options.get("render_mode") or "rgb_array"
    if not mode.startswith("rgb_array"):
        raise UsageError(
            f"task '{task}' cannot render '{mode}'",
            "render_mode is None or 'rgb_array', a map from above",
        )
    if parts is not None and parts["vision"]:
        options = {"observation": "vision", **options}
    return gymnasium.make(TASKS[task].gym_id, **{"upstream_api": not five_values, **options})
