"""ViZDoom's take_cover: one axis for its two buttons, and what flies at the player."""

import gymnasium
import numpy as np
import vizdoom.gymnasium_wrapper  # registers the scenario
from gymnasium.spaces import Box, Dict


class TakeCover(gymnasium.Wrapper):
    def __init__(self):
        super().__init__(gymnasium.make("VizdoomTakeCover-MultiBinary-v1"))
        self.unwrapped.game.set_objects_info_enabled(True)
        self.action_space = Box(-1, 1, (1,), np.float32)  # to the left or to the right
        self.observation_space = Dict({**self.env.observation_space, "near": Box(-3, 3, (20,))})

    def reset(self, **options):
        return self.seen(self.env.reset(**options)[0]), {}

    def step(self, action):
        health = self.unwrapped.game.get_game_variable(vizdoom.GameVariable.HEALTH)
        buttons = np.array([action[0] < -0.3, action[0] > 0.3], np.int8)
        seen, reward, *ended, info = self.env.step(buttons)
        info["hit"] = seen["gamevariables"][0] < health
        return self.seen(seen), reward, *ended, info

    def seen(self, seen):
        """Add where the player is, and the four fireballs that are next to arrive."""
        things = self.unwrapped.state.objects if self.unwrapped.state else ()
        me, balls = np.zeros(4), []
        for player in (thing for thing in things if thing.name == "DoomPlayer"):
            me = placed(player)
            flying = (placed(thing) - me for thing in things if thing.velocity_x)
            balls = sorted(tuple(ball) for ball in flying if ball[0] > 0)
        near = [me, *balls, *[(1, 0, 0, 0)] * 4][:5]
        return {**seen, "near": np.clip(np.ravel(near), -3, 3).astype(np.float32)}


def placed(it):
    return np.array([it.position_x, it.position_y, it.velocity_x, it.velocity_y]) / [500, 300, 8, 8]


gymnasium.register("TakeCover-v0", TakeCover, max_episode_steps=600)
