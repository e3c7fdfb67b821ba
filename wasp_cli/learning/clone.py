"""Cloning of an operator: a policy is fitted to the commands of a person. K decisions, F features,
A components of an action.
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

    features: Tensor  # [K, F] what the operator saw
    command: Tensor  # [K, A] the command for it
    last: Tensor  # [K, A] the command of the decision before; NaN at the first of an episode


def fit_clone(
    seen: Issued,
    nominal: Policy,
    config: CloneConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> tuple[Clone, list[dict[str, float]]]:
    """Fit a clone by maximum likelihood. It begins as the nominal policy.

    Args:
        seen: the decisions to learn from.
        nominal: frozen policy that the clone corrects.
        config: sizes, updates and rates.
        seed: of all draws but the initial weights.
        report: called every 50 updates with the share that is done and a text.

    Returns:
        The frozen clone, and the curve: its mean negative log-likelihood per command over every 50
        updates.
    """
    # -- the correction of the nominal command decays to zero; the shares of the mixture and the
    # spread are a few numbers that have further to go, and no value to decay to
    clone = Clone(seen.features.shape[1], config.hidden, seen.command.shape[1])
    correction: dict[str, Any] = {"params": clone.net.parameters()}
    mixture: dict[str, Any] = {
        "params": [clone.weight_logits, clone.log_spread],
        "lr": FASTER * config.learning_rate,
        "weight_decay": 0.0,
    }
    optimizer = torch.optim.AdamW(
        [correction, mixture], lr=config.learning_rate, weight_decay=config.weight_decay
    )
    rates = [group["lr"] for group in optimizer.param_groups]

    with torch.no_grad():
        nominal_command = nominal(seen.features)
    source = generator(seed)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        # -- sample decisions
        index = torch.randint(len(seen.command), (config.batch,), generator=source)

        # -- loss
        log_density = clone.log_density(
            seen.command[index], seen.features[index], seen.last[index], nominal_command[index]
        )
        loss = -log_density.mean()

        # -- update at a falling rate
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * (1 - 0.95 * update / config.updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(clone.parameters(), 10.0)
        optimizer.step()

        # -- curve
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
