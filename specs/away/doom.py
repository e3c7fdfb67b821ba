"""ViZDoom's labyrinth with an acid floor: two axes for its buttons, and what lies near."""

import gymnasium
import numpy as np
import vizdoom.gymnasium_wrapper  # registers the scenario
from gymnasium.spaces import Box, Dict


class Labyrinth(gymnasium.Wrapper):
    def __init__(self):
        super().__init__(gymnasium.make("VizdoomHealthGatheringSupreme-MultiBinary-v1"))
        self.unwrapped.game.set_objects_info_enabled(True)
        self.action_space = Box(-1, 1, (2,), np.float32)  # turn, ahead
        self.observation_space = Dict({**self.env.observation_space, "near": Box(-1, 1, (12,))})

    def reset(self, **options):
        return self.seen(self.env.reset(**options)[0]), {}

    def step(self, action):
        before = self.unwrapped.game.get_game_variable(vizdoom.GameVariable.HEALTH)
        buttons = np.array([action[0] > 0.3, action[0] < -0.3, action[1] > -0.3], np.int8)
        seen, _, *ended, info = self.env.step(buttons)
        gained = self.unwrapped.game.get_game_variable(vizdoom.GameVariable.HEALTH) - before
        # a medikit gives health; the floor takes 8, a vial 30
        return self.seen(seen), float(gained > 0), *ended, {**info, "poisoned": gained < -15}

    def seen(self, seen):
        things = self.unwrapped.state.objects if self.unwrapped.state else ()
        places = [(thing.name, thing.position_x + 1j * thing.position_y) for thing in things]
        near = {"CustomMedikit": [9e9j] * 3, "Poison": [9e9j] * 3}  # the nearest three of each
        for player in (thing for thing in things if thing.name == "DoomPlayer"):
            me, turned = player.position_x + 1j * player.position_y, np.deg2rad(player.angle)
            for name, place in ((name, place) for name, place in places if name in near):
                near[name].append((place - me) * np.exp(-1j * turned) / 500)
        nearest = np.array([sorted(found, key=abs)[:3] for found in near.values()])
        flat = np.clip([nearest.real, nearest.imag], -1, 1).astype(np.float32).ravel()
        return {**seen, "near": flat}


gymnasium.register("Labyrinth-v0", Labyrinth, max_episode_steps=400)
