"""Operators who know more than assistants perceive: in the task they read its privileged observation.

Imagination has none: there a fork of such an operator follows the latent policy of the same skill, which is all that an assistant may
assume. B = rows, P = size of a privileged observation, A = action size, F = features.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol, Self, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wasp_cli.models.policy import load_privileged
from wasp_cli.operators.base import Memory, NoiseSource, Operator, OperatorContext, Policy, build_operator
from wasp_cli.tasks.base import VectorTask


class Telling(Protocol):
    """A task whose operators know more than its cameras show (`TaskInfo.informed`)."""

    def privileged(self) -> NDArray[np.float32]:
        """Return the privileged observation [B, P] of the present state."""
        ...


def told(task: VectorTask) -> Tensor:
    """Return what operators of a `Telling` task know of its present state, [B, P]."""
    return torch.from_numpy(cast(Telling, task).privileged())


class InformedOperator(Operator):
    """An operator in the task, with the rule and the memory of the one that assistants assume, and intentions of its own."""

    def __init__(self, assumed: Operator, task: VectorTask) -> None:
        self.assumed, self._task = assumed, task
        super().__init__(assumed.policy, assumed.action_size, assumed.noise, assumed.batch)
        self.informed = assumed.informed

    @property
    def draws(self) -> int:
        return self.assumed.draws

    def initial(self, batch: int) -> Memory:
        return self.assumed.initial(batch)

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        return self.assumed.act(intended, memory, uniforms)

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        return super().command(features, told(self._task).to(features.device) if privileged is None else privileged)

    def react(self, executed: Tensor, memory: Memory) -> Memory:
        return self.assumed.react(executed, memory)

    def to(self, device: torch.device) -> Self:
        if isinstance(self.informed, nn.Module):
            self.informed.to(device)
        return super().to(device)

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> Operator:
        self.assumed.memory = self.memory
        forked: Operator = self.assumed.fork(rows, copies, noise)
        return forked


def operator_in(
    task: VectorTask, skill: Callable[[float], Policy], variant: str, value: float | None, noise: NoiseSource, expert: Path | None = None
) -> Operator:
    """Build the operator of the B episodes of a task.

    Args:
        task: of B rows; where there is an expert, one with `TaskInfo.informed`.
        skill: the latent policies.
        variant: of the operator.
        value: its severity.
        noise: of its mistakes.
        expert: an expert artifact, whose privileged policies operators follow in the task; None: they perceive what assistants do.
            One that computes its commands in another way, as a person does, knows what it knows.

    Raises:
        UnknownName: no such variant.
        ArtifactError: the expert has no checkpoint of that skill, or it is damaged.
    """
    informed = None if expert is None else partial(load_privileged, expert)
    operator = build_operator(variant, value, OperatorContext(skill, task.action_size, task.decision_seconds, informed), noise, task.batch)
    own = type(operator).command is not Operator.command
    return operator if operator.informed is None or own else InformedOperator(operator, task)


class Knowledge:
    """What operators of each skill intend in a task where they know more: in the place of `Skills`, where nobody imagines them."""

    def __init__(self, expert: Path, task: VectorTask) -> None:
        """Take the policies of an expert artifact, and what `task` tells, of B rows."""
        self._expert, self._task = expert, task
        self._known: dict[float, Policy] = {}

    def at(self, fraction: float) -> Policy:
        """Return the policy at a fraction of the expert's training: a command [B, A], whatever the features [B, F].

        Raises:
            ArtifactError: there is no checkpoint at that fraction, or it is damaged.
        """
        if fraction not in self._known:  # one object for all operators of a skill: a mixture evaluates each object once
            policy = load_privileged(self._expert, fraction)
            self._known[fraction] = lambda features: policy(told(self._task)).to(features.device)
        return self._known[fraction]
