"""Expert training: stable-baselines3 PPO on privileged observations with an adaptive Lagrange
multiplier; goes on after an interruption.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from wasp_cli.errors import ArtifactError, TaskError
from wasp_cli.learning.configs.recorded import ExpertConfig
from wasp_cli.learning.lagrangian import LagrangianCallback, MultiplierRule
from wasp_cli.learning.reward_unit import GrowingUnit, first_unit, most_excess
from wasp_cli.learning.vec_env import SeedStream, TaskVecEnv, actor_layers
from wasp_cli.models.policy import PrivilegedPolicy, checkpoint_name, save_privileged
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask

# tells of a policy and its interactions whether it is good enough
Accept = Callable[[PrivilegedPolicy, int], bool]


def train_expert(
    task: VectorTask,
    config: ExpertConfig,
    work: Path,
    task_name: str,
    seed: int,
    progress: Callable[[float, str], None],
    accept: Accept = lambda policy, interactions: True,
) -> list[dict[str, float]]:
    """Train and store a skill per checkpoint fraction (`skill-F.safetensors`); goes on from its own
    state in `work`.

    Where the policy is not accepted, training goes on for `config.extension` interactions, at most
    `config.extensions` times. The learning rate then begins at the share of all interactions that
    is left.

    Args:
        task: config.envs episodes with privileged observations.
        work: folder of the skills and of the state of the training itself.
        accept: asked at the end of the training and of every further one.

    Returns:
        The learning curve: a row per rollout.

    Raises:
        ValueError: the cost limit of `config` is `auto`, which the caller has to replace.
    """
    if config.cost_limit == "auto":
        raise ValueError("the cost limit is no number yet")
    torch.manual_seed(derive("expert-weights", task_name, seed))
    low, high = float(task.action_low.min()), float(task.action_high.max())
    seeds = SeedStream("expert-episode", task_name, seed)
    env = TaskVecEnv(task, task.privileged_size, low, high, seeds)
    env.spread = True
    env.growing = GrowingUnit(task_name, first_unit(task, task_name, seed))
    env.unit = env.growing.value
    normalised = VecNormalize(env, norm_obs=True, norm_reward=False, clip_obs=10.0)
    model = PPO(
        "MlpPolicy",
        normalised,
        device="cpu",
        seed=derive("expert-ppo", task_name, seed),
        n_steps=config.rollout,
        batch_size=config.batch,
        n_epochs=config.epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        ent_coef=config.entropy,
        learning_rate=lambda left: config.learning_rate * max(0.1, left),
        policy_kwargs={
            "net_arch": list(config.hidden),
            "activation_fn": nn.Tanh,
            "log_std_init": config.log_std_init,
            "optimizer_kwargs": {"eps": 1e-5, "fused": True},  # stable-baselines3's own eps
        },
    )

    def store(fraction: float) -> None:
        path = work / checkpoint_name(fraction)
        save_privileged(
            export_actor(model, normalised),
            path,
            task.privileged_size,
            config.hidden,
            task.action_size,
        )

    state = TrainingState(work / "training.safetensors", model, env, normalised, seeds)
    rule = MultiplierRule(
        config.multiplier_init,
        config.multiplier_lr,
        config.multiplier_max,
        config.cost_limit,
        floor=config.multiplier_min,
        later=None
        if config.late_cost_limit is None
        else (config.interactions // 2, config.late_cost_limit),
        most_excess=most_excess(task_name),
    )
    early = {
        int(f * config.interactions): functools.partial(store, f)
        for f in config.checkpoints
        if f < 1.0
    }
    callback = LagrangianCallback(
        env,
        rule,
        config.interactions,
        progress,
        log_std_floor=config.log_std_floor,
        checkpoints=early,
        before_rollout=lambda: state.save(callback.curve),
    )
    callback.go_on(state.restore())
    # the default one leaves folders in the temporary directory
    model.set_logger(Logger(folder=None, output_formats=[]))
    restored = model.num_timesteps
    for target in [
        config.interactions + k * config.extension for k in range(config.extensions + 1)
    ]:
        if target <= restored:  # it was not accepted there
            continue
        callback.total = target
        model.learn(
            target - model.num_timesteps,
            callback=callback,
            reset_num_timesteps=model.num_timesteps == 0,
        )
        if accept(export_actor(model, normalised), model.num_timesteps):
            break
    store(1.0)
    return callback.curve


def export_actor(model: PPO, normalised: VecNormalize) -> PrivilegedPolicy:
    """Export the actor of a PPO model and its observation statistics as a plain module."""
    layers = actor_layers(model.policy)
    hidden = [layer.out_features for layer in layers[:-1]]
    policy = PrivilegedPolicy(layers[0].in_features, hidden, layers[-1].out_features)
    own = [m for m in policy.net if isinstance(m, nn.Linear)]
    statistics: Any = normalised.obs_rms
    with torch.no_grad():
        for mine, theirs in zip(own, layers, strict=True):
            mine.weight.copy_(theirs.weight)
            mine.bias.copy_(theirs.bias)
        policy.mean.copy_(torch.as_tensor(statistics.mean))
        policy.std.copy_(torch.as_tensor(np.sqrt(statistics.var + normalised.epsilon)))
        policy.log_std.copy_(model.policy.log_std)
    return policy


class TrainingState:
    """Owners of all that a PPO training changes. A training that goes on from here ends with the
    bytes of an uninterrupted one.

    Args:
        ppo: policy, optimizer, last observation and number of interactions.
        env: episodes in the middle, and the multiplier.
        normalised: its observation statistics.
        seeds: of the episodes to come.
    """

    def __init__(
        self, path: Path, ppo: PPO, env: TaskVecEnv, normalised: VecNormalize, seeds: SeedStream
    ) -> None:
        self._path, self._ppo, self._env, self._seeds = path, ppo, env, seeds
        self._statistics: Any = normalised.obs_rms

    def save(self, curve: list[dict[str, float]]) -> None:
        """Replace the file atomically. A task without snapshots leaves none: its training
        begins anew after an interruption.
        """
        try:
            arrays = {f"env/{name}": array for name, array in self._env.snapshot().items()}
        except TaskError:
            return
        ppo: Any = self._ppo
        arrays |= {
            f"policy/{name}": tensor.numpy() for name, tensor in ppo.policy.state_dict().items()
        }
        for i, state in ppo.policy.optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{i}/{name}": np.asarray(value) for name, value in state.items()}
        # stable-baselines3 shuffles with NumPy's global generator.
        shuffles: Any = np.random.get_state(legacy=False)  # noqa: NPY002
        arrays |= {
            "last_observation": ppo._last_obs,
            "last_starts": ppo._last_episode_starts,
            "torch_generator": torch.get_rng_state().numpy(),
            "numpy_generator": shuffles["state"]["key"],
            "mean": self._statistics.mean,
            "variance": self._statistics.var,
        }
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
        """Put everything back to where the file was saved, and return the learning curve up to
        there; empty when there is no file.
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
        ppo: Any = self._ppo
        self._env.restore(_below("env", arrays))
        ppo.policy.load_state_dict(
            {name: torch.from_numpy(array) for name, array in _below("policy", arrays).items()}
        )
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for name, array in _below("optimizer", arrays).items():
            index, _, which = name.partition("/")
            moments.setdefault(int(index), {})[which] = torch.from_numpy(array)
        optimizer = ppo.policy.optimizer
        optimizer.load_state_dict(
            {"state": moments, "param_groups": optimizer.state_dict()["param_groups"]}
        )
        ppo._last_obs, ppo._last_episode_starts, ppo.num_timesteps = (
            arrays["last_observation"],
            arrays["last_starts"],
            counters["interactions"],
        )
        self._statistics.mean, self._statistics.var, self._statistics.count = (
            arrays["mean"],
            arrays["variance"],
            counters["count"],
        )
        self._env.multiplier, self._seeds.drawn = counters["multiplier"], counters["seeds"]
        self._env.unit = counters.get("unit", 1.0)  # a state of an earlier version has none
        if self._env.growing is not None:
            self._env.growing.value = self._env.unit
        torch.set_rng_state(torch.from_numpy(arrays["torch_generator"]))
        np.random.set_state(("MT19937", arrays["numpy_generator"], *counters["numpy_generator"]))  # noqa: NPY002
        curve: list[dict[str, float]] = counters["curve"]
        return curve


def _below(folder: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The arrays called `folder/...`, without it."""
    return {
        name.removeprefix(f"{folder}/"): array
        for name, array in arrays.items()
        if name.startswith(f"{folder}/")
    }
