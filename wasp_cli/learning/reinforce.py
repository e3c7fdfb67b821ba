"""Reinforcement of a distilled actor: PPO with a Lagrange multiplier on the latents. It is needed
because the labels do not show how to look for a goal that is out of sight.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger
from torch import nn

from wasp_cli.learning.configs.latent import ReinforceConfig
from wasp_cli.learning.lagrangian import LagrangianCallback, MultiplierRule
from wasp_cli.learning.latent_ppo import FilteredTask, ValueWarmup
from wasp_cli.learning.reward_unit import most_excess
from wasp_cli.learning.vec_env import SeedStream
from wasp_cli.models.policy import LatentPolicy
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask


def reinforce(
    actor: LatentPolicy,
    task: VectorTask,
    model: SafetyWorldModel,
    config: ReinforceConfig,
    cost_limit: float,
    name: str,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[LatentPolicy, list[dict[str, float]]]:
    """Maximise the return subject to a cost limit, starting from the weights of the actor.

    Args:
        actor: not changed.
        task: config.envs episodes with what the model reads.
        model: filters.
        config: of PPO and of the multiplier.
        cost_limit: cost per 1000 env steps.
        name: of the task; in the names of the random streams.
        seed: of the training chain.
        report: called after every rollout with the share that is done and a text.

    Returns:
        A trained actor of the same layers, frozen, and the learning curve, a row per rollout.
    """
    # -- the task through the filter
    env = FilteredTask(task, model, SeedStream("reinforce-episode", name, seed))
    env.normalise = True
    env.spread = True
    env.unit = model.sizes.reward_unit

    # -- PPO with a value function of its own
    better = copy.deepcopy(actor).train().requires_grad_(True)
    widths = [layer.out_features for layer in better.net if isinstance(layer, nn.Linear)]
    hidden = widths[:-1]
    ppo = PPO(
        "MlpPolicy",
        env,
        device="cpu",
        seed=derive("reinforce-ppo", name, seed),
        n_steps=config.rollout,
        batch_size=config.batch,
        n_epochs=config.epochs,
        gamma=config.gamma,
        learning_rate=lambda left: config.learning_rate * max(0.1, left),
        policy_kwargs={
            "net_arch": hidden,
            "activation_fn": nn.Tanh,
            "log_std_init": config.log_std_init,
        },
    )

    # -- the distilled layers in place of those of stable-baselines3, which have other activations
    # and no LayerNorm between them
    policy: Any = ppo.policy
    policy.mlp_extractor.policy_net = better.net[:-1]
    policy.action_net = better.net[-1]
    policy.optimizer = torch.optim.Adam(
        policy.parameters(), lr=config.learning_rate, eps=1e-5, fused=True
    )

    # -- the multiplier, which moves once the value function is warm
    warmup = int(config.value_warmup * config.interactions)
    rule = MultiplierRule(
        config.multiplier_init,
        config.multiplier_lr,
        config.multiplier_max,
        cost_limit,
        delay=warmup,
        floor=config.multiplier_min,
        most_excess=most_excess(name),
    )
    lagrangian = LagrangianCallback(
        env, rule, config.interactions, report, log_std_floor=config.log_std_floor
    )

    # -- train; the default logger would leave folders in the temporary directory
    ppo.set_logger(Logger(folder=None, output_formats=[]))
    ppo.learn(config.interactions, callback=CallbackList([ValueWarmup(warmup), lagrangian]))
    return better.eval().requires_grad_(False), lagrangian.curve
