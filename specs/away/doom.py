"""ViZDoom's labyrinth with an acid floor: two axes for its buttons, and what lies near."""

import gymnasium
import numpy as np
import vizdoom.gymnasium_wrapper  # registers the scenario
from gymnasium.spaces import Box, Dict

SCENARIO, HEALTH = "VizdoomHealthGatheringSupreme-MultiBinary-v1", vizdoom.GameVariable.HEALTH


class Labyrinth(gymnasium.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.game = env.unwrapped.game
        self.game.set_objects_info_enabled(True)
        self.action_space = Box(-1, 1, (2,), np.float32)  # turn, ahead
        self.observation_space = Dict(screen=env.observation_space["screen"], near=Box(-1, 1, (12,)))

    def reset(self, **options):
        return self.seen(self.env.reset(**options)[0]), {}

    def step(self, action):
        before = self.game.get_game_variable(HEALTH)
        buttons = np.array([action[0] > 0.3, action[0] < -0.3, action[1] > -0.3], np.int8)
        seen, _, *ended, info = self.env.step(buttons)
        gained = self.game.get_game_variable(HEALTH) - before  # the floor takes 8, a vial 30
        return self.seen(seen), float(gained > 0), *ended, {**info, "poisoned": gained < -15}

    def seen(self, seen):
        things = () if self.unwrapped.state is None else self.unwrapped.state.objects
        places = {"CustomMedikit": [9e9j] * 3, "Poison": [9e9j] * 3}  # the nearest three of each
        for thing in things:
            if thing.name == "DoomPlayer":
                me, ahead = thing.position_x + 1j * thing.position_y, np.deg2rad(thing.angle)
        for thing in (thing for thing in things if thing.name in places):
            away = (thing.position_x + 1j * thing.position_y - me) * np.exp(-1j * ahead)
            places[thing.name].append(away / 500)
        nearest = np.array([sorted(found, key=abs)[:3] for found in places.values()])
        near = np.clip(np.stack([nearest.real, nearest.imag]), -1, 1).ravel()
        return {"screen": seen["screen"], "near": near.astype(np.float32)}


gymnasium.register("Labyrinth-v0", lambda: Labyrinth(gymnasium.make(SCENARIO)), max_episode_steps=400)
