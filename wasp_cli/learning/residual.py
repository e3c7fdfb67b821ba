"""SafeRL-Res: PPO with a Lagrange multiplier over (h, z, a^H), in the real task through the filter.

Mode `lagrangian` is the paper's Eq. 5: the return less the effort, subject to a limit of the cost.
Mode `rsa` is the form of the original (Schaff and Walter 2020): the least effort, subject to a
least return. There lambda weighs the return, and the loss is divided by 1 + lambda; the effort is a
Huber norm and part of the reward, so that an unchanged PPO learns from it.
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
    """The task as the residual policy meets it: it sees (h, z, a^H) and adds delta to a^H.

    The operator of every episode is drawn from all variants and severities.
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
        self._alpha, self._rsa = config.alpha, config.mode == "rsa"
        self._command = torch.zeros(task.batch, task.action_size)
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
        first = torch.from_numpy(rows)
        if rows.any():
            self._operator.reset(first)
            for row in np.flatnonzero(rows):
                self._noise.restart(int(row), self._noise_seed())
        else:  # where rows begin anew, the others were told before
            self._operator.observe(torch.from_numpy(executed))
        features = self.features(seen, first, executed)
        if rows.any() and not rows.all():
            self._command = self._restarted(features, privileged_view(self._operator, seen), first)
        else:
            self._command = self._operator.command(
                features, privileged_view(self._operator, seen)
            ).clamp(-1, 1)
        return torch.cat([features, self._command], -1).numpy()

    def _restarted(
        self, features: torch.Tensor, privileged: torch.Tensor | None, first: torch.Tensor
    ) -> torch.Tensor:
        """Commands [B, A] where new episodes begin in some rows only: the others have been
        issued already and must not move on twice.
        """
        states = [(operator, dict(operator.memory)) for operator in self._operator.operators]
        steps = list(self._noise.step)
        issued = self._operator.command(features, privileged).clamp(-1, 1)
        for operator, memory in states:
            operator.memory = {
                n: torch.where(first.view(-1, *([1] * (v.dim() - 1))), operator.memory[n], v)
                for n, v in memory.items()
            }
        moved = zip(self._noise.step, steps, first.tolist(), strict=True)
        self._noise.step = [after if row else before for after, before, row in moved]
        return torch.where(first.unsqueeze(-1), issued, self._command)

    def execute(self, action: Array) -> tuple[Array, Array]:
        command = self._command.numpy()
        executed = np.clip(command + action, -1, 1)
        squared = np.square(executed - command).sum(-1)  # what is penalised is what was executed
        return executed, (huber(np.sqrt(squared)) if self._rsa else self._alpha * squared).astype(
            np.float32
        )

    def objective(self, step: Step, penalty: Array) -> NDArray[Any]:
        if not self._rsa:
            return super().objective(step, penalty)
        return (self.multiplier * step.reward / self.unit - penalty) / (1.0 + self.multiplier)


def huber(norm: NDArray[Any]) -> NDArray[Any]:
    """Penalise residuals [...]: quadratic up to 1, linear beyond."""
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
        expert_return: per episode of the unimpaired expert; mode `rsa` asks for a share of it.
        informed: privileged policies of operators who know more than assistants perceive, as in
            `OperatorContext`.

    Returns:
        The mean residual as a plain module, and the learning curve.
    """
    torch.manual_seed(derive("residual-weights", name, seed))
    env = AssistedTask(task, model, skills, config, name, seed, informed)
    env.normalise = env.spread = True
    env.unit = model.sizes.reward_unit
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
    rule = _rule(config, expert_return, name)
    lagrangian = LagrangianCallback(env, rule, config.interactions, report)
    # the default one leaves folders in the temporary directory
    ppo.set_logger(Logger(folder=None, output_formats=[]))
    ppo.learn(
        config.interactions,
        callback=CallbackList(
            [ValueWarmup(int(config.value_warmup * config.interactions)), lagrangian]
        ),
    )
    policy = ResidualPolicy(model.feature_size, task.action_size, config.hidden)
    with torch.no_grad():
        for mine, theirs in zip(
            [m for m in policy.net if isinstance(m, nn.Linear)],
            actor_layers(ppo.policy),
            strict=True,
        ):
            mine.weight.copy_(theirs.weight)
            mine.bias.copy_(theirs.bias)
    return policy, lagrangian.curve


def _rule(config: ResidualConfig, expert_return: float, name: str) -> Rule:
    shared = config.multiplier_init, config.multiplier_lr, config.multiplier_max
    delay = int(config.multiplier_delay * config.interactions)
    if config.mode == "lagrangian":
        if config.cost_limit == "auto":
            raise ValueError("the cost limit is no number yet")
        return MultiplierRule(
            *shared, config.cost_limit, delay=delay, most_excess=most_excess(name)
        )
    least = config.return_share * expert_return
    if not least > 0:
        raise TrainingError(
            f"the unimpaired expert returns {expert_return:.2f} per episode, and mode rsa "
            f"asks for {config.return_share:g} of it",
            "train a better expert, or use residual.mode lagrangian",
        )
    return ReturnRule(*shared, least, delay=delay)
