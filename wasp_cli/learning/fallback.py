"""The fallback: a safety critic and an actor that are learned together, by the discounted safety
Bellman equation and the updates of SAC, on recorded transitions and on imagined ones.

Safety margin, discount and data are those of `learning.reachability`. There the fallback is the
safest of a few extreme actions; here it is a policy, as in Oh et al. (2025), and V(h, z) = Q(h, z,
pi(h, z)). B rows, F features, A components of an action.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from wasp_cli.learning.configs.fallback import FallbackConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.models.fallback import SafetyActor
from wasp_cli.models.policy import Skills
from wasp_cli.models.reachability import SafetyValue, danger_target
from wasp_cli.models.world_model import SafetyWorldModel


def train_fallback(
    model: SafetyWorldModel,
    skills: Skills,
    recording: Recording,
    latents: Latents,
    config: FallbackConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[SafetyValue, SafetyActor, list[dict[str, float]]]:
    """Learn Q of an action once and the actor afterwards, and the actor that maximises it. Model
    and policies stay fixed.

    Each update uses recorded transitions, whose cost is known, and from the same latents as many
    imagined ones. The target is that of `danger_target`, with the danger of an action that the
    actor draws at the arrived state, by a slow copy of the critic. The entropy of the actor is not
    part of the target, as in the original.

    Args:
        model: imagines.
        skills: their expert acts in some imagined transitions.
        recording: action, cost, terminal, first and episode of N rows; held-out rows are not
            learned.
        latents: of the N rows.
        config: sizes, updates, discount and rates.
        seed: of all draws but the initial weights.
        report: called every 100 updates with the share that is done and a text.

    Returns:
        Critic and actor, frozen, and the curve: means over every 100 updates.
    """
    # -- networks, and the temperature of SAC
    value = SafetyValue(
        model.feature_size, model.action_size, config.hidden, tuple(model.sizes.action_scales)
    )
    actor = SafetyActor(model.feature_size, model.action_size, [config.hidden, config.hidden])
    slow = copy.deepcopy(value).requires_grad_(False)
    log_temperature = torch.tensor(math.log(config.temperature), requires_grad=True)
    least_entropy = config.entropy * model.action_size
    critic_optimizer = torch.optim.Adam(value.parameters(), lr=config.learning_rate)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=config.learning_rate)
    temperature_optimizer = torch.optim.Adam([log_temperature], lr=config.learning_rate)
    optimizers = (critic_optimizer, actor_optimizer, temperature_optimizer)

    # -- transitions: row i + 1 holds what was executed at the state of row i, and what came of it
    source = generator(seed)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    action = torch.from_numpy(recording.action)
    cost = torch.from_numpy(recording.cost)
    keep = 1 - torch.from_numpy(recording.terminal)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        # -- sample recorded transitions [B]
        row = starts[torch.randint(len(starts), (config.batch,), generator=source)]
        now = latents.at(row)
        then = latents.at(row + 1)
        executed = action[row + 1]
        features = now.features

        # -- anneal the rate: constant for the first half, then down to a tenth
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)

        # -- imagine as many other transitions, and compute the targets [2 B] of both
        with torch.no_grad():
            tried = _tried(value, actor, skills, features, source)
            noise = gumbel((config.batch, model.noise_size), source)
            imagined = model.imagine(now, tried, noise)
            arrived = torch.cat([then.features, imagined.features])
            goes_on = torch.cat([keep[row + 1], model.continues(imagined)])
            # danger behind the arrived states
            onward = goes_on * (1 - _value_of(slow, actor, arrived, source)) / 2
            costs = torch.cat([cost[row + 1], model.cost(imagined)])
            target = danger_target(costs, onward, config.gamma)

        # -- update the critic, and let its slow copy follow
        actions = torch.cat([executed, tried]).unsqueeze(1)
        logits = value.logits(features.repeat(2, 1), actions).squeeze(-1)  # [members, 2 B]
        loss = F.binary_cross_entropy_with_logits(logits, target.expand_as(logits))
        _step(critic_optimizer, loss)
        with torch.no_grad():
            for target_weight, weight in zip(slow.parameters(), value.parameters(), strict=True):
                target_weight.lerp_(weight, config.slow)

        # -- update the actor: the least danger, with the bonus of SAC for its entropy. The gradient
        # is that of the logit of the danger: where Q is almost 1 its own gradient vanishes, and
        # both have the same maximum.
        sampled, density = actor.sample(features, _normals(executed, source))
        danger = value.logits(features, sampled.unsqueeze(1)).amax(0).squeeze(1)  # [B]
        temperature = log_temperature.detach().exp()
        _step(actor_optimizer, (danger + temperature * density).mean())

        # -- update the temperature, so that the entropy stays at its target
        _step(temperature_optimizer, -(log_temperature * (density.detach() + least_entropy)).mean())

        # -- curve
        recent.append(torch.stack([loss.detach(), target.mean(), -density.detach().mean()]))
        if update % 100 == 99 or update == config.updates - 1:
            loss_mean, danger_mean, entropy_mean = torch.stack(recent).mean(0).tolist()
            recent.clear()
            curve.append(
                {
                    "update": update + 1,
                    "loss": loss_mean,
                    "danger": danger_mean,
                    "entropy": entropy_mean,
                }
            )
            report(
                (update + 1) / config.updates,
                f"update {update + 1}/{config.updates}, loss {loss_mean:.3f}, danger "
                f"{danger_mean:.3f}",
            )
    value.eval().requires_grad_(False)
    actor.eval().requires_grad_(False)
    return value, actor, curve


def _step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    """Update the parameters of an optimizer, and no others: the actor's loss runs through the
    critic, which must not change.
    """
    optimizer.zero_grad(set_to_none=True)
    parameters = [each for group in optimizer.param_groups for each in group["params"]]
    gradients = torch.autograd.grad(loss, parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    optimizer.step()


def _normals(like: Tensor, source: torch.Generator) -> Tensor:
    return torch.randn(tuple(like.shape), generator=source)


def _value_of(
    critic: SafetyValue, actor: SafetyActor, features: Tensor, source: torch.Generator
) -> Tensor:
    """Return Q [B] of actions that the actor draws."""
    normal = torch.randn(len(features), critic.extremes.shape[1], generator=source)
    sampled, _ = actor.sample(features, normal)
    value: Tensor = critic(features, sampled.unsqueeze(1)).squeeze(1)
    return value


def _tried(
    value: SafetyValue,
    actor: SafetyActor,
    skills: Skills,
    features: Tensor,
    source: torch.Generator,
) -> Tensor:
    """Draw an action [B, A] for each row: the actor's, the expert's, a uniform or an extreme one,
    equally likely.
    """
    expert = skills.expert(features)
    batch = len(features)
    uniform = 2 * torch.rand(tuple(expert.shape), generator=source) - 1
    extreme = value.extremes[torch.randint(len(value.extremes), (batch,), generator=source)]
    sampled, _ = actor.sample(features, _normals(expert, source))
    kinds = torch.stack([sampled, expert, uniform, extreme])  # [4, B, A]
    return kinds[torch.randint(4, (batch,), generator=source), torch.arange(batch)]


@torch.inference_mode()
def fallback_quality(
    value: SafetyValue, actor: SafetyActor, features: Tensor
) -> dict[str, float | None]:
    """Return how the actor compares with the safest extreme action at features [B, F]: the means of
    both values, and the share of rows in which the actor is at least as safe. None without a row.
    """
    if not len(features):
        return {"actor": None, "extreme": None, "at_least_as_safe": None}
    own = value(features, actor(features).unsqueeze(1)).squeeze(1)
    _, extreme = value.fallback(features)
    return {
        "actor": float(own.mean()),
        "extreme": float(extreme.mean()),
        "at_least_as_safe": float((own >= extreme).float().mean()),
    }
