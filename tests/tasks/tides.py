"""Environments of somebody else's in a module that other processes find, for tests of batches in
several processes.
"""

import os
import signal
import subprocess
from pathlib import Path

import gymnasium
import numpy as np

TOLD = "TIDES_TOLD"
"""The environment variable with the file in which environments tell what became of them."""
MAIN = "TIDES_MAIN"
"""The environment variable with the number of the process in which nobody dies."""


def tell(text):
    if TOLD in os.environ:
        with Path(os.environ[TOLD]).open("a") as file:
            file.write(f"{text}\n")


class Tides(gymnasium.Env):
    """A level that its actions and chance move; a flood costs, a drought ends the episode."""

    metadata = {"render_modes": [], "render_fps": 10}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        {
            "image": gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8),
            "privileged": gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32),
        }
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.clock, self.level = 0, self.np_random.normal()
        return self.seen(), {}

    def step(self, action):
        self.clock += 1
        self.level += float(action[0]) + 0.3 * self.np_random.normal()
        flood = {"high": float(self.level > 1.0), "waves": float(self.level * action[1] > 1.0)}
        info = {"cost": sum(flood.values()), "cost_sources": flood, "goals": self.clock // 5}
        return self.seen(), float(action[1]) - self.level**2, bool(self.level < -3.0), False, info

    def seen(self):
        image = self.np_random.integers(0, 256, (8, 8, 3), np.uint8)
        privileged = np.array([self.level, self.clock, self.np_random.normal()], np.float32)
        return {"image": image, "privileged": privileged}

    def snapshot(self):
        state = self.np_random.bit_generator.state["state"]
        words = [state[name] >> shift & 2**64 - 1 for name in ("state", "inc") for shift in (0, 64)]
        return {
            "own": np.array([self.clock, self.level]),
            "random": np.array(words, np.uint64),
            "rest": np.array(
                [self.np_random.bit_generator.state[name] for name in ("has_uint32", "uinteger")]
            ),
        }

    def restore(self, snapshot):
        self.clock, self.level = int(snapshot["own"][0]), float(snapshot["own"][1])
        words = [int(word) for word in snapshot["random"]]
        state = self.np_random.bit_generator.state
        state["state"] = {"state": words[0] | words[1] << 64, "inc": words[2] | words[3] << 64}
        state["has_uint32"], state["uinteger"] = map(int, snapshot["rest"])
        self.np_random.bit_generator.state = state

    def close(self):
        tell(f"closed in {os.getpid()}")


class Failing(Tides):
    """The worlds of odd seeds fail in their fourth step."""

    def reset(self, *, seed=None, options=None):
        self.is_odd = bool(seed % 2)
        return super().reset(seed=seed)

    def step(self, action):
        if self.is_odd and self.clock == 3:
            raise OSError(f"the pump is clogged at {self.level:.3f}")
        return super().step(action)


class Dying(Tides):
    """One process dies of a signal in the fourth step of the world 7, unless it is the main one."""

    def reset(self, *, seed=None, options=None):
        self.seed = seed
        return super().reset(seed=seed)

    def step(self, action):
        if self.seed == 7 and self.clock == 3 and str(os.getpid()) != os.environ[MAIN]:
            print("the dam breaks")
            os.kill(os.getpid(), signal.SIGSEGV)
        return super().step(action)


class Unwilling(Tides):
    def close(self):
        super().close()
        raise OSError("the gate is stuck")


class Starting(Tides):
    """Starts a process of its own, and leaves it; tells what signals do where it is made."""

    def __init__(self):
        handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        ignored = [handler is signal.SIG_IGN for handler in handlers]
        pump = subprocess.Popen(["sleep", "600"])
        tell(f"pump {pump.pid} {any(ignored)}")


class Drawn(Tides):
    """Draws its level."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def render(self):
        return np.full((12, 16, 3), int(np.clip(128 + 40 * self.level, 0, 255)), np.uint8)


for made in (Tides, Failing, Dying, Unwilling, Starting, Drawn):
    gymnasium.register(f"{made.__name__}-v0", entry_point=made, max_episode_steps=60)
