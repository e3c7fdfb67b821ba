"""The tasks as standard gymnasium environments: `gymnasium.make("wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0")`.

Importing this module registers every implemented task under the namespace `wasp/`; MuJoCo is imported when one is made.
The cost comes as `info["cost"]`, as in the 5-tuple environments of the reference package.
"""

from __future__ import annotations

from typing import Any, Literal, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import CAMERA_SIZE, HasMap, Observation, Pixels
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

MAP_SIZE = 256

ObservationName = Literal["state", "pixels", "privileged"]


class TaskEnv(gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """One episode of a task.

    Args:
        task: a name of `wasp_cli.tasks.registry.TASKS`.
        observation: `state` (float64 [S], the reference package's vector), `pixels` (uint8 [6, 64, 64]) or `privileged` (float32 [P]).
        action_repeat: env steps per `step`; rewards and costs add up.
        render_mode: `rgb_array` gives a map from above.

    `info` of a step: `cost` (env steps that cost, 0 or 1 without action repeat), `cost_sources` (the same per source), `goals` (reached
    in this episode so far), `success` (whether they are as many as the task asks for).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        self._task = make_task(task, 1, action_repeat=action_repeat, observe=(observation,))
        self._name: ObservationName = observation
        self._success_goals = TASKS[task].success_goals
        self._goals = 0
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self._task.decision_seconds)}
        if render_mode is not None and (render_mode != "rgb_array" or not isinstance(self._task, HasMap)):
            raise UsageError(f"task '{task}' cannot render '{render_mode}'", "render_mode is None or 'rgb_array'")
        self.render_mode = render_mode
        self.action_space = gymnasium.spaces.Box(self._task.action_low, self._task.action_high, dtype=np.float64)
        spaces: dict[str, gymnasium.Space[NDArray[Any]]] = {
            "state": gymnasium.spaces.Box(-np.inf, np.inf, (self._task.state_size,), np.float64),
            "pixels": gymnasium.spaces.Box(0, 255, (6, CAMERA_SIZE, CAMERA_SIZE), np.uint8),
            "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (self._task.privileged_size,), np.float32),
        }
        self.observation_space = spaces[observation]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode. A seed names a layout, the same as in the reference package; without one a new layout is drawn."""
        super().reset(seed=seed, options=options)
        layout = int(self.np_random.integers(SEED_LIMIT)) if seed is None else seed
        self._goals = 0
        return self._first(self._task.reset([layout])), {}

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by `action_repeat` env steps."""
        step = self._task.step(np.asarray(action)[None])
        self._goals += int(step.goals[0])
        terminated = bool(step.terminated[0])
        info = {
            "cost": float(step.cost_env[0]),
            "cost_sources": {name: float(count[0]) for name, count in step.sources.items()},
            "goals": self._goals,
            "success": self._goals >= self._success_goals,
        }
        return self._first(step.observation), float(step.reward[0]), terminated, bool(step.ended[0]) and not terminated, info

    def render(self) -> Pixels | None:
        """The map from above, uint8 [256, 256, 3]."""
        if self.render_mode is None:
            return None
        assert isinstance(self._task, HasMap)
        return self._task.topdown(0, MAP_SIZE)

    def _first(self, observation: Observation) -> NDArray[Any]:
        value = getattr(observation, self._name)
        first: NDArray[Any] = value[0]
        return first


def register_envs() -> None:
    """Register every implemented task that is not registered yet."""
    for name in TASKS:
        info = TASKS[name]
        if info.implemented and info.gym_id not in gymnasium.registry:
            # The tasks keep their own time limit, which is why no TimeLimit wrapper is asked for.
            gymnasium.register(id=info.gym_id, entry_point="wasp_cli.tasks.gym:TaskEnv", kwargs={"task": name})


register_envs()
