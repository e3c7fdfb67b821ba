"""The fallback: a safety critic and an actor learned together, by the discounted safety Bellman
equation and the updates of SAC, on recorded transitions and on imagined ones.

Safety margin, discount and data are those of `learning.reachability`. There the fallback is the
safest of a few extreme actions; here it is a policy, as in Oh et al. (2025), and V(h, z) = Q(h, z,
pi(h, z)). B rows, F features, A actions.
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
    """Learn Q of an action once and the actor afterwards, and the actor that maximises it; model
    and policies stay fixed, and no held-out row is seen.

    Each update sees recorded transitions, whose cost is known, and from the same latents as many
    imagined ones. The target is that of `danger_target`, with the danger of an action that the
    actor draws at the arrived state, by a slow copy of the critic. Its entropy is no part of the
    target, as in the original.

    Args:
        recording: action, cost, terminal and episode of the recorded rows.

    Returns:
        Critic and actor, frozen, and the curve: means over every 100 updates.
    """
    value = SafetyValue(
        model.feature_size, model.action_size, config.hidden, tuple(model.sizes.action_scales)
    )
    actor = SafetyActor(model.feature_size, model.action_size, [config.hidden, config.hidden])
    slow = copy.deepcopy(value).requires_grad_(False)
    log_temperature = torch.tensor(math.log(config.temperature), requires_grad=True)
    least_entropy = config.entropy * model.action_size
    optimizers = [
        torch.optim.Adam(parameters, lr=config.learning_rate)
        for parameters in (value.parameters(), actor.parameters(), [log_temperature])
    ]
    source = generator(seed)
    windows = recording.window_starts(2)
    starts = torch.from_numpy(windows[~recording.held_out(HELD_OUT)[windows]])
    action = torch.from_numpy(recording.action)
    cost = torch.from_numpy(recording.cost)
    keep = 1 - torch.from_numpy(recording.terminal)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        row = starts[torch.randint(len(starts), (config.batch,), generator=source)]
        now = latents.at(row)
        then = latents.at(row + 1)
        did = action[row + 1]
        features = now.features
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * min(1.0, 1.9 - 1.8 * update / config.updates)

        # The critic: what was executed, and in imagination what nobody did.
        with torch.no_grad():
            tried = _tried(value, actor, skills, features, source)
            found = model.imagine(now, tried, gumbel((config.batch, model.noise_size), source))
            arrived = torch.cat([then.features, found.features])
            goes_on = torch.cat([keep[row + 1], model.continues(found)])
            onward = goes_on * (1 - _value_of(slow, actor, arrived, source)) / 2
            target = danger_target(
                torch.cat([cost[row + 1], model.cost(found)]), onward, config.gamma
            )
        actions = torch.cat([did, tried]).unsqueeze(1)
        logits = value.logits(features.repeat(2, 1), actions).squeeze(-1)  # [members, 2 B]
        loss = F.binary_cross_entropy_with_logits(logits, target.expand_as(logits))
        _step(optimizers[0], loss)
        with torch.no_grad():
            for old, new in zip(slow.parameters(), value.parameters(), strict=True):
                old.lerp_(new, config.slow)

        # The actor: the least danger, at an entropy. The logit of the danger and not Q is climbed:
        # where Q is almost 1 its slope vanishes, and the safest action is the same.
        drawn, density = actor.sample(features, _normals(did, source))
        danger = value.logits(features, drawn.unsqueeze(1)).amax(0).squeeze(1)  # [B]
        temperature = log_temperature.detach().exp()
        _step(optimizers[1], (danger + temperature * density).mean())
        _step(optimizers[2], -(log_temperature * (density.detach() + least_entropy)).mean())

        recent.append(torch.stack([loss.detach(), target.mean(), -density.detach().mean()]))
        if update % 100 == 99 or update == config.updates - 1:
            means = torch.stack(recent).mean(0).tolist()
            recent.clear()
            names = ("loss", "danger", "entropy")
            curve.append({"update": update + 1, **dict(zip(names, means, strict=True))})
            report(
                (update + 1) / config.updates,
                f"update {update + 1}/{config.updates}, loss {means[0]:.3f}, danger {means[1]:.3f}",
            )
    value.eval().requires_grad_(False)
    actor.eval().requires_grad_(False)
    return value, actor, curve


def _step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad(set_to_none=True)
    parameters = [each for group in optimizer.param_groups for each in group["params"]]
    # Only its own parameters: the actor's loss runs through the critic and leaves it alone.
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
    drawn, _ = actor.sample(features, normal)
    value: Tensor = critic(features, drawn.unsqueeze(1)).squeeze(1)
    return value


def _tried(
    value: SafetyValue,
    actor: SafetyActor,
    skills: Skills,
    features: Tensor,
    source: torch.Generator,
) -> Tensor:
    """Draw an action [B, A] for each row: the actor's, the expert's, a uniform or an extreme one,
    by chance.
    """
    expert = skills.expert(features)
    batch = len(features)
    uniform = 2 * torch.rand(tuple(expert.shape), generator=source) - 1
    extreme = value.extremes[torch.randint(len(value.extremes), (batch,), generator=source)]
    drawn, _ = actor.sample(features, _normals(expert, source))
    kinds = torch.stack([drawn, expert, uniform, extreme])  # [4, B, A]
    return kinds[torch.randint(4, (batch,), generator=source), torch.arange(batch)]


@torch.inference_mode()
def fallback_quality(
    value: SafetyValue, actor: SafetyActor, features: Tensor
) -> dict[str, float | None]:
    """Return how the actor compares with the safest extreme action at features [B, F]: means of
    both values, and the share of rows in which the actor is at least as safe.
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
