"""The expert of the external worlds: Stable-Baselines3's SAC on the observation with the goal."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from tests.external.flights import alone
from tests.external.lander import Floats, GoalLander, Kind
from wasp_cli.operators.base import Policy

ENVS = 8
HIDDEN = (128, 128)
HOLD = 4  # steps for which a command is held while the expert learns
# rewards are learned at a tenth, so that values do not begin three orders of magnitude below what
# they are to become
SCALE = 0.1
RANDOM, FIRST, BLOCK = 10_000, 20_000, 2000
"""Decisions at random, decisions before the first look at the expert, and between two looks."""
WORLDS = 100
SKILL: dict[Kind, float] = {"lander": 0.773, "reacher": 0.493}
"""Share of goals that the authors' experts reach: a better one would leave the assistant less
to do, and the pilots more able.
"""


class Held(GoalLander):
    """The world as the expert learns it: a command is held for some steps, which shortens the
    way from an act to what comes of it.
    """

    def __init__(self, kind: Kind, hold: int) -> None:
        super().__init__(kind)
        self.hold = hold

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        total = 0.0
        for _ in range(self.hold):
            seen, reward, terminated, truncated, info = super().step(action)
            total += reward * SCALE
            if terminated or truncated:
                break
        return seen, total, terminated, truncated, info


def train_expert(kind: Kind, folder: Path, report: Callable[[str], None] = print) -> None:
    """Train until the expert reaches as many goals as the authors' one, and go on from what is in
    the folder.

    Every `BLOCK` decisions the folder has `model.zip`, `buffer.pkl` and a line of `curve.jsonl`:
    the shares of `WORLDS` fresh worlds, at every step of which the mean action is executed, that
    were reached and crashed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    envs = DummyVecEnv([lambda: Held(kind, HOLD)] * ENVS)
    envs.seed(0)
    saved, curve = folder / "model.zip", folder / "curve.jsonl"
    if saved.exists():
        model = SAC.load(saved, envs, device="cpu")
        model.load_replay_buffer(folder / "buffer.pkl")
    else:
        model = SAC(
            "MlpPolicy",
            envs,
            learning_rate=7e-4,
            buffer_size=500_000,
            batch_size=256,
            gamma=0.99,
            tau=0.01,
            learning_starts=RANDOM,
            train_freq=1,
            gradient_steps=4,
            ent_coef="auto_0.2",
            policy_kwargs={"net_arch": list(HIDDEN)},
            seed=0,
            device="cpu",
        )
    while (
        not curve.exists()
        or json.loads(curve.read_text().splitlines()[-1])["reached"] < SKILL[kind]
    ):
        begun = time.perf_counter()
        model.learn(BLOCK if model.num_timesteps else FIRST, reset_num_timesteps=False)
        model.save_replay_buffer(folder / "buffer.pkl")
        model.save(saved)
        loop = alone(kind, "expert", actor(model), range(WORLDS))
        line = {
            "decisions": model.num_timesteps,
            "reached": float(loop.goals.sum()) / WORLDS,
            "crashed": float(loop.cost.sum()) / WORLDS,
        }
        with curve.open("a") as file:
            file.write(json.dumps(line | {"seconds": round(time.perf_counter() - begun)}) + "\n")
        report(f"{kind}: {line}")


def actor(model: SAC) -> Policy:
    """Return the expert's mean action: observations with the goal [B, P] to commands [B, 2] in
    [-1, 1].
    """
    return lambda observation: model.policy.actor(observation, deterministic=True)
