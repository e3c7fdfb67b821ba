"""The state of an interrupted PPO training on disk: weights, Adam moments, observation statistics,
running episodes and generators as safetensors, counters as JSON.
"""

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
    """Saves and restores everything that a PPO training changes. A training that goes on from its
    saved state ends with the same bytes as an uninterrupted one.

    Args:
        path: the file.
        ppo: policy, optimizer, last observation and number of interactions.
        env: the running episodes, and the multiplier.
        normalised: observation statistics of `env`.
        seeds: of the episodes to come.
    """

    def __init__(
        self, path: Path, ppo: PPO, env: TaskVecEnv, normalised: VecNormalize, seeds: SeedStream
    ) -> None:
        self._path = path
        self._ppo = ppo
        self._env = env
        self._seeds = seeds
        self._statistics: Any = normalised.obs_rms

    def save(self, curve: list[dict[str, float]]) -> None:
        """Replace the file atomically; `curve` is the learning curve so far.

        A task without snapshots leaves no file: its training begins anew after an interruption.
        """
        # -- episodes
        arrays: dict[str, NDArray[Any]] = {}
        try:
            for name, array in self._env.snapshot().items():
                arrays[f"env/{name}"] = array
        except TaskError:
            return

        # -- weights and Adam moments
        ppo: Any = self._ppo
        for name, tensor in ppo.policy.state_dict().items():
            arrays[f"policy/{name}"] = tensor.numpy()
        for i, moments in ppo.policy.optimizer.state_dict()["state"].items():
            for name, value in moments.items():
                arrays[f"optimizer/{i}/{name}"] = np.asarray(value)

        # -- observations and generators; stable-baselines3 shuffles with NumPy's global one
        shuffles: Any = np.random.get_state(legacy=False)  # noqa: NPY002
        arrays["last_observation"] = ppo._last_obs
        arrays["last_starts"] = ppo._last_episode_starts
        arrays["torch_generator"] = torch.get_rng_state().numpy()
        arrays["numpy_generator"] = shuffles["state"]["key"]
        arrays["mean"] = self._statistics.mean
        arrays["variance"] = self._statistics.var

        counters = {
            "interactions": ppo.num_timesteps,
            "seeds": self._seeds.drawn,
            "multiplier": self._env.multiplier,
            "unit": self._env.unit,
            "curve": curve,
            "count": float(self._statistics.count),
            "numpy_generator": [shuffles["state"]["pos"], shuffles["has_gauss"], shuffles["gauss"]],
        }
        partial = self._path.with_suffix(".partial")
        save_file(
            {name: np.array(array, order="C") for name, array in arrays.items()},
            partial,
            metadata={"counters": json.dumps(counters)},
        )
        os.replace(partial, self._path)

    def restore(self) -> list[dict[str, float]]:
        """Put everything back to where the file was saved.

        Returns:
            The learning curve up to there; empty when there is no file.

        Raises:
            ArtifactError: the file cannot be read.
        """
        if not self._path.exists():
            return []
        try:
            arrays = load_file(self._path)
            with safe_open(self._path, "np") as file:
                counters: dict[str, Any] = json.loads(file.metadata()["counters"])
        except (OSError, SafetensorError) as error:
            raise ArtifactError(
                f"cannot read {self._path}: {error}",
                "remove it and run again: the training begins anew",
            ) from error

        # -- episodes
        self._env.restore(_below("env", arrays))

        # -- weights and Adam moments
        ppo: Any = self._ppo
        ppo.policy.load_state_dict(
            {name: torch.from_numpy(array) for name, array in _below("policy", arrays).items()}
        )
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for name, array in _below("optimizer", arrays).items():
            index, _, moment = name.partition("/")
            moments.setdefault(int(index), {})[moment] = torch.from_numpy(array)
        optimizer = ppo.policy.optimizer
        optimizer.load_state_dict(
            {"state": moments, "param_groups": optimizer.state_dict()["param_groups"]}
        )

        # -- observations and counters
        ppo._last_obs = arrays["last_observation"]
        ppo._last_episode_starts = arrays["last_starts"]
        ppo.num_timesteps = counters["interactions"]
        self._statistics.mean = arrays["mean"]
        self._statistics.var = arrays["variance"]
        self._statistics.count = counters["count"]
        self._seeds.drawn = counters["seeds"]
        self._env.multiplier = counters["multiplier"]
        self._env.unit = counters.get("unit", 1.0)  # earlier versions saved no unit
        if self._env.growing is not None:
            self._env.growing.value = self._env.unit

        # -- generators
        torch.set_rng_state(torch.from_numpy(arrays["torch_generator"]))
        generator = ("MT19937", arrays["numpy_generator"], *counters["numpy_generator"])
        np.random.set_state(generator)  # noqa: NPY002
        curve: list[dict[str, float]] = counters["curve"]
        return curve


def _below(folder: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the arrays called `folder/NAME`, by NAME."""
    prefix = f"{folder}/"
    return {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
