"""B episodes of a task as a gymnasium vector environment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Step, VectorTask
from wasp_cli.tasks.gym.arguments import checked_control, refuse_other_task, refuse_unknown
from wasp_cli.tasks.gym.env import OPTIONS, TaskEnv
from wasp_cli.tasks.gym.observing import ObservationName, observed_task

VECTOR_OPTIONS = (
    *(name for name in OPTIONS if name != "upstream_api"),
    "threads",
    "autoreset_mode",
    "max_episode_steps",
)


@dataclass
class _Batch:
    """What the rows of a vector share."""

    task: VectorTask
    step: Step | None = None  # the last one, of all rows


class _Row(TaskEnv):
    """One episode of a batch, which its vector advances."""

    def __init__(self, batch: _Batch, row: int, **options: Any) -> None:
        self._batch = batch
        self._row = row
        super().__init__(**options)

    def _made(self, task: str, observation: str, action_repeat: int) -> VectorTask:
        return self._batch.task

    def _advance(self, action: NDArray[Any]) -> Step:
        assert self._batch.step is not None
        return self._batch.step


class TaskVectorEnv(SyncVectorEnv):
    """B episodes of a task, stepped in one call: what `gymnasium.make_vec(id, num_envs=B)` gives.

    It is gymnasium's `SyncVectorEnv`, the same step by step, but physics and cameras of all rows
    are computed together, which is several times as fast. A copy (`copy.deepcopy`, pickle) goes on
    bit for bit.

    Arguments are those of `TaskEnv`. `autoreset_mode` says what becomes of an episode that ended:
    another starts with the next step, whose action it ignores (`NextStep`), with the same step
    (`SameStep`; the last observation is `infos["final_obs"]`), or when `reset` is called
    (`Disabled`). `threads` of physics and cameras change no result. `max_episode_steps` truncates
    episodes earlier than the task does.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        threads: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        registered: str | None = None,
        **options: Any,
    ) -> None:
        refuse_other_task(task, registered)
        refuse_unknown("TaskVectorEnv", task, options, VECTOR_OPTIONS)
        self._batch = _Batch(observed_task(task, num_envs, observation, action_repeat, threads))
        options = {"task": task, "observation": observation, **options}

        def made(row: int) -> gymnasium.Env[Any, Any]:
            env = _Row(self._batch, row, **options)
            if max_episode_steps is None:
                return env
            return gymnasium.wrappers.TimeLimit(env, max_episode_steps)

        super().__init__(
            [partial(made, row) for row in range(num_envs)], autoreset_mode=autoreset_mode
        )
        self.env_fns = ()  # no pickle could hold them

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Advance every running episode under `actions` [B, A], and start new ones where
        `autoreset_mode` says so. Raises TaskError where the actions are no array [B, A] of finite
        numbers, or, with `Disabled`, where an episode has ended and was not reset.
        """
        control = checked_control(actions, (self.num_envs, self._batch.task.action_size))
        over = self._autoreset_envs
        if self.autoreset_mode is AutoresetMode.DISABLED and over.any():
            ended = ", ".join(map(str, np.flatnonzero(over)))
            raise TaskError(
                f"step after the end of row {ended}",
                "call reset(options={'reset_mask': terminated | truncated})",
            )
        if not (self.autoreset_mode is AutoresetMode.NEXT_STEP and over.all()):
            self._batch.step = self._batch.task.step(control)
        return super().step(control)
