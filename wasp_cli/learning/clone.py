"""Cloning of an operator: a policy fitted to what one commanded. K decisions, F features, A
actions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from wasp_cli.learning.configs.latent import CloneConfig
from wasp_cli.learning.sampling import generator
from wasp_cli.models.clone import Clone
from wasp_cli.operators.base import Policy

# learning rate of the mixture's shares and of the spread, relative to that of the weights
FASTER = 10.0


class Issued(NamedTuple):
    """K decisions of one operator."""

    features: Tensor  # [K, F] what it saw
    command: Tensor  # [K, A] what it issued
    last: Tensor  # [K, A] what it had issued one decision before; NaN at the first of an episode


def fit_clone(
    seen: Issued,
    nominal: Policy,
    config: CloneConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Clone, list[dict[str, float]]]:
    """Fit a clone by maximum likelihood; it begins as the nominal policy.

    Args:
        seen: the decisions to learn from.
        nominal: policy that the clone corrects, frozen.

    Returns:
        The frozen clone, and its negative log-likelihood per command over the updates.
    """
    clone = Clone(seen.features.shape[1], config.hidden, seen.command.shape[1])
    # The few numbers that say how commands come about have further to go than the weights, and
    # nothing to be drawn back to.
    few: dict[str, Any] = {
        "params": [clone.weight_logits, clone.log_spread],
        "lr": FASTER * config.learning_rate,
        "weight_decay": 0.0,
    }
    optimizer = torch.optim.AdamW(
        [{"params": clone.net.parameters()}, few],
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
    )
    rates = [group["lr"] for group in optimizer.param_groups]
    with torch.no_grad():
        wanted = nominal(seen.features)
    source = generator(seed)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        index = torch.randint(len(seen.command), (config.batch,), generator=source)
        loss = -clone.log_density(
            seen.command[index], seen.features[index], seen.last[index], wanted[index]
        ).mean()
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * (1 - 0.95 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(clone.parameters(), 10.0)
        optimizer.step()
        recent.append(loss.detach())
        if update % 50 == 49 or update == config.updates - 1:
            curve.append({"update": update + 1, "loss": float(torch.stack(recent).mean())})
            recent.clear()
            report(
                (update + 1) / config.updates,
                f"update {update + 1}/{config.updates}, loss {curve[-1]['loss']:.2f}",
            )
    clone.eval().requires_grad_(False)
    return clone, curve
