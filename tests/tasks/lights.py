"""A small environment of somebody else's, for tests of tasks that come by their gymnasium id."""

import itertools
from typing import Any

import gymnasium
import numpy as np

NUMBER = itertools.count()


def registered(env: Any, **options: Any) -> str:
    name = f"Foreign{next(NUMBER)}-v0"
    gymnasium.register(name, entry_point=env, **{"max_episode_steps": 20, **options})
    return name


class Lights(gymnasium.Env):
    """Shows its last action and its clock; every step asks one question of the adapter."""

    metadata = {"render_modes": [], "render_fps": 25}
    action_space: gymnasium.Space = gymnasium.spaces.Box(
        np.array([-2.0, 0.0]), np.array([4.0, 10.0]), dtype=np.float64
    )
    observation_space: gymnasium.Space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    ends_at = 10**9

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.clock, self.got = 0, []
        return self.seen(), {}

    def step(self, action):
        self.clock += 1
        self.got.append(np.array(action))
        return self.seen(), 1.0, self.clock >= self.ends_at, False, self.info()

    def seen(self):
        return np.full((64, 64, 3), self.clock, np.uint8)

    def info(self):
        return {"cost": float(self.clock % 3 == 0)}
