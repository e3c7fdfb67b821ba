"""Cloning of an operator: a policy fitted to what one issued in Human-only episodes, and how well it foretells the next command.

Nothing of the operator's rule is read: features and commands are all that there is of a person. K decisions, B episodes, F features,
A actions, S draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from wasp_cli.learning.closed_loop import Loop
from wasp_cli.learning.configs.latent import CloneConfig
from wasp_cli.learning.sampling import generator
from wasp_cli.methods.base import Decision
from wasp_cli.models.base import Latent
from wasp_cli.models.clone import Clone
from wasp_cli.operators.base import DrawnNoise, Operator, Policy

KERNEL, FLOOR = 0.1, 0.01
"""Standard deviation of the kernel that makes a density of draws, and the share of a uniform density in it: no command is impossible."""
FASTER = 10.0
"""Learning rate of the mixture's shares and of the spread, relative to that of the weights."""


class Issued(NamedTuple):
    """K decisions of one operator."""

    features: Tensor
    """[K, F] what it saw"""
    command: Tensor
    """[K, A] what it issued"""
    last: Tensor
    """[K, A] what it had issued one decision before; NaN at the first of an episode"""


def issued(loop: Loop) -> Issued:
    """Take the decisions of B recorded episodes, without those after an episode's end."""
    assert loop.h is not None
    assert loop.z is not None
    alive = torch.from_numpy(loop.alive.copy())
    command = torch.from_numpy(loop.a_h.copy())
    last = torch.cat([torch.full_like(command[:1], torch.nan), command[:-1]])
    features = Latent(loop.h, loop.z).features
    return Issued(*(values[alive].clone() for values in (features, command, last)))  # inference tensors cannot be learned from


def fit_clone(
    seen: Issued, nominal: Policy, config: CloneConfig, seed: int, report: Callable[[float, str], None]
) -> tuple[Clone, list[dict[str, float]]]:
    """Fit a clone by maximum likelihood; it begins as the nominal policy.

    Args:
        seen: the decisions to learn from.
        nominal: policy that the clone corrects, frozen.
        config: sizes and budget.
        seed: of the batches.
        report: called every 50 updates.

    Returns:
        The frozen clone, and its negative log-likelihood per command over the updates.
    """
    clone = Clone(seen.features.shape[1], config.hidden, seen.command.shape[1])
    # The few numbers that say how commands come about have further to go than the weights, and nothing to be drawn back to.
    few: dict[str, Any] = {"params": [clone.weight_logits, clone.log_spread], "lr": FASTER * config.learning_rate, "weight_decay": 0.0}
    optimizer = torch.optim.AdamW([{"params": clone.net.parameters()}, few], lr=config.learning_rate, weight_decay=config.weight_decay)
    rates = [group["lr"] for group in optimizer.param_groups]
    with torch.no_grad():
        wanted = nominal(seen.features)
    source = generator(seed)
    curve: list[dict[str, float]] = []
    recent: list[Tensor] = []
    for update in range(config.updates):
        index = torch.randint(len(seen.command), (config.batch,), generator=source)
        loss = -clone.log_density(seen.command[index], seen.features[index], seen.last[index], wanted[index]).mean()
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
            report((update + 1) / config.updates, f"update {update + 1}/{config.updates}, loss {curve[-1]['loss']:.2f}")
    clone.eval().requires_grad_(False)
    return clone, curve


class Foreteller:
    """An assistant that executes every command as it is, and notes how well some models of the operator foretold it."""

    def __init__(self, models: Mapping[str, Callable[[Operator, Tensor], Operator]], draws: int, seed: int) -> None:
        """Foretell by draws of each model.

        Args:
            models: by name, what makes the operator to go on with of the real one and the commands a_h [B, A] that it has just issued.
            draws: S of each, of the next command.
            seed: of the draws.
        """
        self.models, self._draws, self._source = models, draws, generator(seed)
        self._next: dict[str, Operator] = {}
        self.log_score: dict[str, list[Tensor]] = {name: [] for name in models}
        """by model, per decision from the second on: log-density [B] of the command"""
        self.error: dict[str, list[Tensor]] = {name: [] for name in models}
        """by model, per decision from the second on: squared distance [B] of the command from the mean of the draws"""

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        self._next = {}

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        batch, actions = a_h.shape
        for name, waiting in self._next.items():
            drawn = waiting.command(latent.features.repeat_interleave(self._draws, 0)).clamp(-1, 1).view(batch, self._draws, actions)
            self.log_score[name].append(log_score(drawn, a_h))
            self.error[name].append((drawn.mean(1) - a_h).square().sum(-1))
        rows = torch.arange(batch)
        for name, model in self.models.items():
            imagined = model(operator, a_h)
            uniforms = torch.rand((1, batch * self._draws, imagined.draws), generator=self._source)
            self._next[name] = imagined.fork(rows, self._draws, DrawnNoise(uniforms))
            self._next[name].observe(a_h.repeat_interleave(self._draws, 0))
        return Decision(a_h)


def log_score(drawn: Tensor, command: Tensor) -> Tensor:
    """Return the log-density [B] of commands [B, A] under Gaussian kernels around draws [B, S, A], with a share of uniform density."""
    actions = command.shape[-1]
    distance = ((drawn - command.unsqueeze(1)) / KERNEL).square().sum(-1)  # [B, S]
    near: Tensor = (-0.5 * distance).exp().mean(1) / (KERNEL * math.sqrt(2 * math.pi)) ** actions
    return ((1 - FLOOR) * near + FLOOR / math.pow(2.0, actions)).log()


def judged(told: Foreteller, loop: Loop) -> dict[str, dict[str, float]]:
    """Return `log_score` (larger is better) and `squared_error` by model, means over the decisions of the loop from the second on."""
    alive = torch.from_numpy(loop.alive.copy())[1:]
    return {
        name: {
            "log_score": float(torch.stack(told.log_score[name])[alive].mean()),
            "squared_error": float(torch.stack(told.error[name])[alive].mean()),
        }
        for name in told.models
    }
