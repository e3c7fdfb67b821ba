"""Puddle: a point drives to a flag, and every env step with a wet foot costs. A task of one's
own for `wasp`, complete.
"""

from __future__ import annotations

import gymnasium
import numpy as np

# radius of a puddle, radius of the flag, most metres per env step
WET, REACHED, STEP = 0.3, 0.15, 0.05


class Puddle(gymnasium.Env):
    """Positions in m on a field of 2 x 2; the camera looks down and moves with the point."""

    metadata = {"render_modes": [], "render_fps": 10}  # ten env steps are a second
    action_space = gymnasium.spaces.Box(-STEP, STEP, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        {
            # all that an assistant sees
            "image": gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8),
            # what the expert learns from
            "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (8,), np.float32),
        }
    )

    def reset(self, *, seed=None, options=None):
        # every draw comes from self.np_random, so that a seed names a world
        super().reset(seed=seed)
        self.point = self.np_random.uniform([-0.9, -0.9], [-0.6, 0.9])
        self.flag = self.np_random.uniform([0.6, -0.9], [0.9, 0.9])
        self.puddles = self.np_random.uniform([-0.4, -0.8], [0.4, 0.8], (3, 2))
        return self._seen(), {}

    def step(self, action):
        before = np.linalg.norm(self.flag - self.point)
        self.point = np.clip(self.point + action, -1.0, 1.0)
        distance = np.linalg.norm(self.flag - self.point)
        wet = np.linalg.norm(self.puddles - self.point, axis=1) < WET
        success = bool(distance < REACHED)
        info = {
            "cost": float(wet.any()),
            "cost_sources": {"water": float(wet.any())},
            "success": success,
        }
        return self._seen(), float(10.0 * (before - distance) + success), success, False, info

    def _seen(self):
        # [64, 2]: the camera shows 2 x 2 m around the point
        across = self.point + (np.arange(64)[:, None] - 31.5) / 32.0
        place = np.stack(np.meshgrid(across[:, 0], across[:, 1]), -1)  # [64, 64, 2]
        image = np.where((np.floor(place * 4).sum(-1) % 2 > 0)[..., None], 200, 220) + np.zeros(3)
        image[(np.abs(place) > 1.0).any(-1)] = (90, 70, 50)  # beyond the fence
        for puddle in self.puddles:
            image[np.linalg.norm(place - puddle, axis=-1) < WET] = (60, 90, 220)
        image[np.linalg.norm(place - self.flag, axis=-1) < REACHED] = (40, 180, 60)
        image[np.linalg.norm(place - self.point, axis=-1) < 0.06] = (200, 40, 40)
        privileged = np.concatenate([self.flag - self.point, (self.puddles - self.point).ravel()])
        return {"image": image.astype(np.uint8), "privileged": privileged.astype(np.float32)}

    # Counterfactual measures return to an earlier step: without these two methods the episode is
    # played again up to there, which takes longer.

    def snapshot(self):
        return {
            "point": self.point.copy(),
            "flag": self.flag.copy(),
            "puddles": self.puddles.copy(),
        }

    def restore(self, snapshot):
        self.point, self.flag, self.puddles = (
            snapshot[name].copy() for name in ("point", "flag", "puddles")
        )


gymnasium.register("Puddle-v0", entry_point="puddle:Puddle", max_episode_steps=200)
