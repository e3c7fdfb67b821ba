"""A task that shows a vector alone, as a module for a folder of one's own: Puddle without its
image. Assistants see where the flag and the puddles are, in mm, and a number that never changes.
"""

from pathlib import Path

from tests.commands import ROOT

NAME = "bare:Bare-v0"
SIZE = 9  # components of its vector
MODULE = """
import gymnasium
import numpy as np
from puddle import Puddle


class Bare(Puddle):
    observation_space = gymnasium.spaces.Dict(
        {"state": gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float64)}
    )

    def _seen(self):
        places = np.concatenate([self.flag - self.point, (self.puddles - self.point).ravel()])
        return {"state": np.append(1000.0 * places, 250.0)}


gymnasium.register("Bare-v0", entry_point="bare:Bare", max_episode_steps=200)
"""


def write_module(folder: Path) -> None:
    """Write the modules of `NAME` into a folder."""
    puddle = ROOT / "docs" / "examples" / "puddle.py"
    (folder / "puddle.py").write_text(puddle.read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "bare.py").write_text(MODULE, encoding="utf-8")
