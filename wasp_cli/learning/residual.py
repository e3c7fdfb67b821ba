"""SafeRL-Res: PPO with a Lagrange multiplier over (h, z, a^H), in the real task through the filter.

Mode `lagrangian` is Eq. 5 of the paper: the return minus the effort, subject to a limit of the
cost. Mode `rsa` is the form of the original (Schaff and Walter 2020): the least effort, subject to
a least return. There lambda weighs the return, and the loss is divided by 1 + lambda; the effort is
a Huber norm and part of the reward, so that PPO itself is unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger
from torch import nn

from wasp_cli.errors import TrainingError
from wasp_cli.learning.closed_loop import privileged_view
from wasp_cli.learning.configs.baselines import ResidualConfig
from wasp_cli.learning.lagrangian import LagrangianCallback, MultiplierRule, ReturnRule, Rule
from wasp_cli.learning.latent_ppo import FilteredTask, ValueWarmup
from wasp_cli.learning.reward_unit import most_excess
from wasp_cli.learning.vec_env import Array, SeedStream, actor_layers
from wasp_cli.models.policy import Skills
from wasp_cli.models.residual import ResidualPolicy
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, Policy, build_operator
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import Observation, Step, VectorTask


class AssistedTask(FilteredTask):
    """The task as the residual policy sees it: observations are (h, z, a^H), and the policy's
    action delta is added to a^H.

    The operator of every episode is drawn from all variants and severities of `config.operators`.
    """

    def __init__(
        self,
        task: VectorTask,
        model: SafetyWorldModel,
        skills: Skills,
        config: ResidualConfig,
        name: str,
        seed: int,
        informed: Callable[[float], Policy] | None = None,
    ) -> None:
        self._alpha = config.alpha
        self._rsa = config.mode == "rsa"
        self._command = torch.zeros(task.batch, task.action_size)  # a^H of the latest observation

        # -- operators of all variants and severities, one of which each row follows
        self._noise = EpisodeNoise([0] * task.batch)
        context = OperatorContext(skills.at, task.action_size, task.decision_seconds, informed)
        operators = []
        for variant, values in sorted(config.operators.items()):
            for value in values:
                operators.append(build_operator(variant, value, context, self._noise, task.batch))
        self._operator = MixedOperator(
            operators, self._noise, derive("residual-operators", name, seed)
        )
        self._noise_seed = SeedStream("residual-noise", name, seed)
        super().__init__(
            task,
            model,
            SeedStream("residual-episode", name, seed),
            extra=task.action_size,
            bound=2.0,
        )

    @torch.no_grad()
    def observe(self, seen: Observation, rows: NDArray[np.bool_], executed: Array) -> Array:
        """Return (h, z, a^H) [B, F + A], see `TaskVecEnv.observe`."""
        # -- the operators learn what was executed, or begin anew
        first = torch.from_numpy(rows)
        if rows.any():
            self._operator.reset(first)
            for row in np.flatnonzero(rows):
                self._noise.restart(int(row), self._noise_seed())
        else:  # where some rows begin anew, the call before this one told the others
            self._operator.observe(torch.from_numpy(executed))

        # -- latents, and the commands for them
        features = self.features(seen, first, executed)
        privileged = privileged_view(self._operator, seen)
        if rows.any() and not rows.all():
            self._command = self._restarted(features, privileged, first)
        else:
            self._command = self._operator.command(features, privileged).clamp(-1, 1)
        return torch.cat([features, self._command], -1).numpy()

    def _restarted(
        self, features: torch.Tensor, privileged: torch.Tensor | None, first: torch.Tensor
    ) -> torch.Tensor:
        """Return commands [B, A] where new episodes begin in the rows `first` [B] only. The other
        rows have their commands already, so their operators and draws must not move on again.
        """
        # -- command all rows
        memories = [dict(operator.memory) for operator in self._operator.operators]
        steps = list(self._noise.step)
        command = self._operator.command(features, privileged).clamp(-1, 1)

        # -- take it back in the rows that go on
        for operator, memory in zip(self._operator.operators, memories, strict=True):
            operator.memory = {
                name: _where_rows(first, operator.memory[name], before)
                for name, before in memory.items()
            }
        self._noise.step = [
            after if is_first else before
            for is_first, after, before in zip(first.tolist(), self._noise.step, steps, strict=True)
        ]
        return torch.where(first.unsqueeze(-1), command, self._command)

    def execute(self, action: Array) -> tuple[Array, Array]:
        """Return the corrected command within the bounds [B, A], and the effort [B]: of the
        correction that is executed, which the bounds may have made smaller.
        """
        command = self._command.numpy()
        executed = np.clip(command + action, -1, 1)
        squared = np.square(executed - command).sum(-1)
        effort = huber(np.sqrt(squared)) if self._rsa else self._alpha * squared
        return executed, effort.astype(np.float32)

    def objective(self, step: Step, penalty: Array) -> NDArray[Any]:
        """Return the reward [B] that is learned from. In mode `rsa` (lambda * r / unit - effort)
        / (1 + lambda); otherwise see `TaskVecEnv.objective`.
        """
        if not self._rsa:
            return super().objective(step, penalty)
        return (self.multiplier * step.reward / self.unit - penalty) / (1.0 + self.multiplier)


def _where_rows(mask: torch.Tensor, chosen: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Return `chosen` [B, ...] in the rows of a mask [B], and `other` in the rest."""
    return torch.where(mask.view(-1, *([1] * (other.dim() - 1))), chosen, other)


def huber(norm: NDArray[Any]) -> NDArray[Any]:
    """Return the penalty of norms [...]: quadratic up to 1, linear beyond."""
    return np.where(norm <= 1.0, 0.5 * np.square(norm), norm - 0.5)


def train_residual(
    task: VectorTask,
    model: SafetyWorldModel,
    skills: Skills,
    config: ResidualConfig,
    name: str,
    seed: int,
    report: Callable[[float, str], None],
    expert_return: float = math.nan,
    informed: Callable[[float], Policy] | None = None,
) -> tuple[ResidualPolicy, list[dict[str, float]]]:
    """Train the residual policy in one of its modes, see the module.

    Args:
        task: config.envs episodes with what the model reads.
        model: filters.
        skills: latent policies that the operators follow.
        config: of PPO, of the multiplier and of the mode; its cost limit is a number.
        name: of the task; in the names of the random streams.
        seed: of the training chain.
        report: called after every rollout with the share that is done and a text.
        expert_return: mean return per episode of the unimpaired expert; mode `rsa` requires a share
            of it.
        informed: privileged policies of operators who know more than assistants perceive, as in
            `OperatorContext`.

    Returns:
        The mean residual as a plain module, and the learning curve, a row per rollout.

    Raises:
        TrainingError: mode `rsa`, and the expert's return is not positive.
        ValueError: the cost limit is `auto`, which the caller has to replace.
    """
    # -- the task with its operators
    torch.manual_seed(derive("residual-weights", name, seed))
    env = AssistedTask(task, model, skills, config, name, seed, informed)
    env.normalise = True
    env.spread = True
    env.unit = model.sizes.reward_unit

    # -- PPO, whose mean residual is zero at the beginning
    ppo = PPO(
        "MlpPolicy",
        env,
        device="cpu",
        seed=derive("residual-ppo", name, seed),
        n_steps=config.rollout,
        batch_size=config.batch,
        n_epochs=config.epochs,
        gamma=config.gamma,
        ent_coef=config.entropy,
        learning_rate=config.learning_rate,
        policy_kwargs={
            "net_arch": list(config.hidden),
            "activation_fn": nn.Tanh,
            "log_std_init": config.log_std_init,
            "optimizer_kwargs": {"eps": 1e-5, "fused": True},  # stable-baselines3's own eps
        },
    )
    output = actor_layers(ppo.policy)[-1]
    nn.init.zeros_(output.weight)
    nn.init.zeros_(output.bias)

    # -- train; the default logger would leave folders in the temporary directory
    rule = _rule(config, expert_return, name)
    lagrangian = LagrangianCallback(env, rule, config.interactions, report)
    warmup = ValueWarmup(int(config.value_warmup * config.interactions))
    ppo.set_logger(Logger(folder=None, output_formats=[]))
    ppo.learn(config.interactions, callback=CallbackList([warmup, lagrangian]))

    # -- copy the actor into a plain module
    policy = ResidualPolicy(model.feature_size, task.action_size, config.hidden)
    layers = [module for module in policy.net if isinstance(module, nn.Linear)]
    with torch.no_grad():
        for layer, trained in zip(layers, actor_layers(ppo.policy), strict=True):
            layer.weight.copy_(trained.weight)
            layer.bias.copy_(trained.bias)
    return policy, lagrangian.curve


def _rule(config: ResidualConfig, expert_return: float, name: str) -> Rule:
    """Return how the multiplier of the mode moves; raises what `train_residual` does."""
    delay = int(config.multiplier_delay * config.interactions)
    if config.mode == "lagrangian":
        if config.cost_limit == "auto":
            raise ValueError("residual.cost_limit is still 'auto': replace it by a number first")
        return MultiplierRule(
            config.multiplier_init,
            config.multiplier_lr,
            config.multiplier_max,
            config.cost_limit,
            delay=delay,
            most_excess=most_excess(name),
        )
    least = config.return_share * expert_return
    if not least > 0:
        raise TrainingError(
            f"the unimpaired expert returns {expert_return:.2f} per episode, and mode rsa "
            f"asks for {config.return_share:g} of it",
            "train a better expert, or use residual.mode lagrangian",
        )
    return ReturnRule(
        config.multiplier_init,
        config.multiplier_lr,
        config.multiplier_max,
        least,
        delay=delay,
    )
