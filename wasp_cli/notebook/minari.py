"""A stored cell as a Minari dataset: its episodes played again in the gymnasium environment of the task."""

from __future__ import annotations

from typing import Any

import gymnasium
import minari
import numpy as np
from numpy.typing import NDArray

import wasp_cli.tasks.gym  # noqa: F401  # registers the ids
from wasp_cli.errors import ArtifactError


class Commanded(gymnasium.Wrapper):
    """Adds the command that the operator issued on an observation to its info; NaN on the last one of an episode."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.commands: NDArray[np.float32] = np.zeros((0, 2), np.float32)  # [T, A] of the episode to come
        self._t = 0

    def reset(self, **arguments: Any) -> Any:
        seen, info = self.env.reset(**arguments)
        self._t = 0
        return seen, self._told(info)

    def step(self, action: Any) -> Any:
        seen, reward, terminated, truncated, info = self.env.step(action)
        self._t += 1
        return seen, reward, terminated, truncated, self._told(info)

    def _told(self, info: dict[str, Any]) -> dict[str, Any]:
        actions = self.action_space.shape or (2,)
        issued = self.commands[self._t] if self._t < len(self.commands) else np.full(actions, np.nan, np.float32)
        return {**info, "command": issued}


def written(name: str, env_id: str, recorded: Any, action_repeat: int, observation: str, description: str) -> Any:
    commanded = Commanded(gymnasium.make(env_id, observation=observation, action_repeat=action_repeat))
    env = minari.DataCollector(commanded, record_infos=True, jpeg_encoding=False)
    for e, (layout, actions, rewards) in enumerate(zip(recorded.layouts, recorded.a, recorded.reward, strict=True)):
        commanded.commands = recorded.a_h[e]
        env.reset(seed=int(layout))
        for t, (action, earned) in enumerate(zip(actions, rewards, strict=True)):
            _, reward, terminated, truncated, _ = env.step(action)
            last = t == len(actions) - 1
            if np.float32(reward) != np.float32(earned) or bool(terminated or truncated) != last:
                raise ArtifactError(f"episode {e} is another one from decision {t} on: it cannot be exported")
    return env.create_dataset(
        name, algorithm_name="wasp drive", author="wasp", author_email="", code_permalink="wasp", description=description
    )
