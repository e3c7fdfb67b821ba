"""Expert training: stable-baselines3 PPO on privileged observations with an adaptive Lagrange
multiplier; goes on after an interruption.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from wasp_cli.learning.configs.recorded import ExpertConfig
from wasp_cli.learning.lagrangian import LagrangianCallback, LaterLimit, MultiplierRule
from wasp_cli.learning.ppo_state import TrainingState
from wasp_cli.learning.reward_unit import GrowingUnit, first_unit, most_excess
from wasp_cli.learning.vec_env import SeedStream, TaskVecEnv, actor_layers
from wasp_cli.models.policy import PrivilegedPolicy, checkpoint_name, save_privileged
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask

Accept = Callable[[PrivilegedPolicy, int], bool]
"""From a policy and the interactions of its training so far to whether it is good enough."""


def train_expert(
    task: VectorTask,
    config: ExpertConfig,
    work: Path,
    task_name: str,
    seed: int,
    progress: Callable[[float, str], None],
    accept: Accept = lambda policy, interactions: True,
) -> list[dict[str, float]]:
    """Train, and store a skill per checkpoint fraction (`skill-F.safetensors`). An interrupted
    training goes on from its own state in `work`.

    Where the policy is not accepted, training goes on for `config.extension` interactions, at most
    `config.extensions` times. The learning rate of such an extension begins at the share of all
    interactions that is left.

    Args:
        task: config.envs episodes with privileged observations.
        config: of PPO and of the multiplier; its cost limit is a number.
        work: folder of the skills and of the state of the training.
        task_name: in the names of the random streams.
        seed: of the training chain.
        progress: called after every rollout with the share that is done and a text.
        accept: called at the end of the training and of every extension.

    Returns:
        The learning curve: a row per rollout.

    Raises:
        ValueError: the cost limit of `config` is `auto`, which the caller has to replace.
        ArtifactError: the state in `work` cannot be read.
    """
    if config.cost_limit == "auto":
        raise ValueError("expert.cost_limit is still 'auto': replace it by a number first")

    # -- the task, with normalised observations and a unit of rewards that grows
    torch.manual_seed(derive("expert-weights", task_name, seed))
    low = float(task.action_low.min())
    high = float(task.action_high.max())
    seeds = SeedStream("expert-episode", task_name, seed)
    env = TaskVecEnv(task, task.privileged_size, low, high, seeds)
    env.spread = True
    env.growing = GrowingUnit(task_name, first_unit(task, task_name, seed))
    env.unit = env.growing.value
    normalised = VecNormalize(env, norm_obs=True, norm_reward=False, clip_obs=10.0)

    # -- PPO
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
        """Write the actor as it is now."""
        path = work / checkpoint_name(fraction)
        save_privileged(
            export_actor(model, normalised),
            path,
            task.privileged_size,
            config.hidden,
            task.action_size,
        )

    # -- the multiplier, the checkpoints, and the state after every rollout
    state = TrainingState(work / "training.safetensors", model, env, normalised, seeds)
    later: LaterLimit | None = None
    if config.late_cost_limit is not None:
        later = LaterLimit(config.interactions // 2, config.late_cost_limit)
    rule = MultiplierRule(
        config.multiplier_init,
        config.multiplier_lr,
        config.multiplier_max,
        config.cost_limit,
        floor=config.multiplier_min,
        later=later,
        most_excess=most_excess(task_name),
    )
    early = {
        int(fraction * config.interactions): functools.partial(store, fraction)
        for fraction in config.checkpoints
        if fraction < 1.0
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

    # -- train, and go on until the policy is accepted
    model.set_logger(Logger(folder=None, output_formats=[]))  # the default one leaves folders
    restored = model.num_timesteps
    for extension in range(config.extensions + 1):
        target = config.interactions + extension * config.extension
        if target <= restored:  # an earlier run came this far, and was not accepted here
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
    """Copy the actor of a PPO model and the statistics of its observations into a plain module."""
    trained_layers = actor_layers(model.policy)
    hidden = [layer.out_features for layer in trained_layers[:-1]]
    policy = PrivilegedPolicy(
        trained_layers[0].in_features, hidden, trained_layers[-1].out_features
    )
    layers = [module for module in policy.net if isinstance(module, nn.Linear)]
    statistics: Any = normalised.obs_rms
    with torch.no_grad():
        for layer, trained in zip(layers, trained_layers, strict=True):
            layer.weight.copy_(trained.weight)
            layer.bias.copy_(trained.bias)
        policy.mean.copy_(torch.as_tensor(statistics.mean))
        policy.std.copy_(torch.as_tensor(np.sqrt(statistics.var + normalised.epsilon)))
        policy.log_std.copy_(model.policy.log_std)
    return policy
