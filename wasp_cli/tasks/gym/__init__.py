"""The tasks as gymnasium environments:
`gymnasium.make("wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0")`, or a batch by `make_vec`.

Importing this package registers every task under the namespace `wasp/`; MuJoCo is imported when one
is made.
"""

from __future__ import annotations

import gymnasium

from wasp_cli.tasks.gym.env import TaskEnv
from wasp_cli.tasks.gym.safety_gymnasium import upstream
from wasp_cli.tasks.gym.vector import TaskVectorEnv
from wasp_cli.tasks.registry import TASKS

__all__ = ["TaskEnv", "TaskVectorEnv", "register_envs", "upstream"]


def register_envs() -> None:
    """Register every task with gymnasium, unless its id is registered already."""
    for name in TASKS:
        info = TASKS[name]
        if info.gym_id in gymnasium.registry:
            continue
        # The tasks keep their own time limit, so that no TimeLimit wrapper is asked for. They check
        # actions themselves, and gymnasium's checker would refuse the six values of `upstream`.
        gymnasium.register(
            id=info.gym_id,
            entry_point="wasp_cli.tasks.gym:TaskEnv",
            vector_entry_point="wasp_cli.tasks.gym:TaskVectorEnv",
            disable_env_checker=True,
            kwargs={"task": name, "registered": name},
        )


register_envs()
