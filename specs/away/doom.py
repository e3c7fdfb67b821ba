"""ViZDoom's take_cover: one axis for its two buttons, and what flies at the player."""

import gymnasium
import numpy as np
import vizdoom.gymnasium_wrapper  # noqa: F401  (registers the scenario)
from gymnasium.spaces import Box, Dict


class TakeCover(gymnasium.Wrapper):
    def __init__(self):
        super().__init__(gymnasium.make("VizdoomTakeCover-MultiBinary-v1"))
        self.unwrapped.game.set_objects_info_enabled(True)
        self.action_space = Box(-1, 1, (1,), np.float32)  # to the left or to the right
        self.observation_space = Dict({**self.env.observation_space, "near": Box(-1, 1, (18,))})

    def reset(self, **options):
        self.health = 100
        return self.seen(self.env.reset(**options)[0]), {}

    def step(self, action):
        buttons = np.array([action[0] < -0.3, action[0] > 0.3], np.int8)
        seen, reward, *ended, info = self.env.step(buttons)
        hit = seen["gamevariables"][0] < self.health
        self.health = seen["gamevariables"][0]
        return self.seen(seen), reward, *ended, {**info, "hit": hit}

    def seen(self, seen):
        """Add where the player is, and the four fireballs that are next to arrive."""
        things = self.unwrapped.state.objects if self.unwrapped.state else ()
        near = np.tile([1.0, 0, 0, 0], (5, 1))
        for me in (thing for thing in things if thing.name == "DoomPlayer"):
            near[0] = [me.position_y / 700, me.velocity_y / 10, 0, 0]
            for row, (ahead, ball) in enumerate(sorted(approaching(things, me))[:4], 1):
                across = (ball[0] - me.position_y) / 300
                near[row] = [ahead / 500, across, ball[1] / 10, ball[2] / 10]
        return {**seen, "near": np.delete(near.clip(-1, 1), [2, 3]).astype(np.float32)}


def approaching(things, me):
    for thing in things:
        if thing.name == "DoomImpBall" and thing.velocity_x and thing.position_x > me.position_x:
            ball = (thing.position_y, thing.velocity_x, thing.velocity_y)
            yield thing.position_x - me.position_x, ball


gymnasium.register("TakeCover-v0", TakeCover, max_episode_steps=600)
