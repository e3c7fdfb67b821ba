"""The state of a PPO training between two rollouts, as safetensors with its counters as JSON: what an interrupted training goes on from."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from wasp_cli.errors import ArtifactError, TaskError
from wasp_cli.learning.vec_env import SeedStream, TaskVecEnv


class TrainingState:
    """Owners of all that a PPO training changes. A training that goes on from here ends with the bytes of an uninterrupted one.

    Args:
        path: the file.
        ppo: policy, optimizer, last observation and number of interactions.
        env: episodes in the middle, and the multiplier.
        normalised: its observation statistics.
        seeds: of the episodes to come.
    """

    def __init__(self, path: Path, ppo: PPO, env: TaskVecEnv, normalised: VecNormalize, seeds: SeedStream) -> None:
        self._path, self._ppo, self._env, self._seeds = path, ppo, env, seeds
        self._statistics: Any = normalised.obs_rms

    def save(self, curve: list[dict[str, float]]) -> None:
        """Replace the file atomically. A task without snapshots leaves none: its training begins anew after an interruption."""
        try:
            arrays = {f"env/{name}": array for name, array in self._env.snapshot().items()}
        except TaskError:
            return
        ppo: Any = self._ppo
        arrays |= {f"policy/{name}": tensor.numpy() for name, tensor in ppo.policy.state_dict().items()}
        for i, state in ppo.policy.optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{i}/{name}": np.asarray(value) for name, value in state.items()}
        # stable-baselines3 shuffles with NumPy's global generator.
        shuffles: Any = np.random.get_state(legacy=False)  # noqa: NPY002
        arrays |= {
            "last_observation": ppo._last_obs, "last_starts": ppo._last_episode_starts, "torch_generator": torch.get_rng_state().numpy(),
            "numpy_generator": shuffles["state"]["key"], "mean": self._statistics.mean, "variance": self._statistics.var,
        }  # fmt: skip
        counters = {
            "interactions": ppo.num_timesteps, "seeds": self._seeds.drawn, "multiplier": self._env.multiplier, "curve": curve,
            "count": float(self._statistics.count), "numpy_generator": [shuffles["state"]["pos"], shuffles["has_gauss"], shuffles["gauss"]],
        }  # fmt: skip
        partial = self._path.with_suffix(".partial")
        save_file(
            {name: np.array(array, order="C") for name, array in arrays.items()}, partial, metadata={"counters": json.dumps(counters)}
        )
        os.replace(partial, self._path)

    def restore(self) -> list[dict[str, float]]:
        """Put everything back to where the file was saved, and return the learning curve up to there; empty when there is no file.

        Raises:
            ArtifactError: the file is damaged.
        """
        if not self._path.exists():
            return []
        try:
            arrays = load_file(self._path)
            with safe_open(self._path, "np") as file:
                counters: dict[str, Any] = json.loads(file.metadata()["counters"])
        except (OSError, SafetensorError) as error:
            raise ArtifactError(f"cannot read {self._path}: {error}", "remove it and run again: the training begins anew") from error
        ppo: Any = self._ppo
        self._env.restore(_below("env", arrays))
        ppo.policy.load_state_dict({name: torch.from_numpy(array) for name, array in _below("policy", arrays).items()})
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for name, array in _below("optimizer", arrays).items():
            index, _, which = name.partition("/")
            moments.setdefault(int(index), {})[which] = torch.from_numpy(array)
        optimizer = ppo.policy.optimizer
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
        ppo._last_obs, ppo._last_episode_starts, ppo.num_timesteps = (
            arrays["last_observation"],
            arrays["last_starts"],
            counters["interactions"],
        )
        self._statistics.mean, self._statistics.var, self._statistics.count = arrays["mean"], arrays["variance"], counters["count"]
        self._env.multiplier, self._seeds.drawn = counters["multiplier"], counters["seeds"]
        torch.set_rng_state(torch.from_numpy(arrays["torch_generator"]))
        np.random.set_state(("MT19937", arrays["numpy_generator"], *counters["numpy_generator"]))  # noqa: NPY002
        curve: list[dict[str, float]] = counters["curve"]
        return curve


def _below(folder: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The arrays called `folder/...`, without it."""
    return {name.removeprefix(f"{folder}/"): array for name, array in arrays.items() if name.startswith(f"{folder}/")}
