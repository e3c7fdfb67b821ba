"""The contract of a simulated operator: an intended policy and an impairment with memory.

The same class runs in the task (noise from the episode's stream) and in imagination (forked from the real memory, with
draws of its own), which is the paper's "same pi_H". B = rows, A = action size, F = size of what the policy reads
(latent features at evaluation, privileged observations while data are collected).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from wasp_cli.operators.noise import NoiseSource

Policy = Callable[[Tensor], Tensor]
"""[B, F] to a command [B, A] in [-1, 1]."""
Memory = dict[str, Tensor]
"""Tensors whose first dimension is B."""


@dataclass(frozen=True)
class OperatorContext:
    """What an operator variant is built from, besides its severity and its noise."""

    skill: Callable[[float], Policy]
    """The policy at a fraction of the expert's training (1.0 is the expert)."""
    action_size: int
    """A"""
    decision_seconds: float
    """Seconds between two commands."""


class Operator:
    """An unimpaired operator, and the base of the impaired ones."""

    noise_size: ClassVar[int] = 0
    """Uniforms per decision beyond those for an action."""
    draws_action: ClassVar[bool] = False
    """Whether a decision also needs A uniforms for a random action."""

    def __init__(self, policy: Policy, action_size: int, noise: NoiseSource, batch: int) -> None:
        self.policy, self.action_size, self.noise, self.batch = policy, action_size, noise, batch
        self.memory = self.initial(batch)

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """An operator of severity `value`."""
        return cls(context.skill(1.0), context.action_size, noise, batch)

    @property
    def draws(self) -> int:
        """Uniforms per decision and row."""
        return self.noise_size + (self.action_size if self.draws_action else 0)

    def initial(self, batch: int) -> Memory:
        """The memory at the start of an episode."""
        return {}

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """From the intended command [B, A] and uniforms [B, draws] to the issued command and the next memory."""
        return intended, memory

    def command(self, features: Tensor) -> Tensor:
        """a^H [B, A] for what the operator sees now; moves memory and noise on by one decision."""
        issued, self.memory = self.act(self.policy(features), self.memory, self.noise.next(self.draws))
        return issued

    def reset(self, rows: Tensor) -> None:
        """Clear the memory of rows [B] (bool) for new episodes."""
        fresh = self.initial(self.batch)
        for name, old in self.memory.items():
            mask = rows.view(-1, *([1] * (old.dim() - 1)))
            self.memory[name] = torch.where(mask, fresh[name], old)

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> Operator:
        """The same operator in imagination: `copies` adjacent copies of each of `rows` (indices), with other noise."""
        forked = object.__new__(type(self))
        forked.__dict__.update(self.__dict__)
        forked.noise, forked.batch = noise, len(rows) * copies
        forked.memory = {name: value[rows].repeat_interleave(copies, 0) for name, value in self.memory.items()}
        return forked

    def snapshot(self) -> Memory:
        """Memory and position of the noise: after `restore` of it the same commands follow, bit for bit."""
        return {"noise": self.noise.position(), **{name: value.clone() for name, value in self.memory.items()}}

    def restore(self, snapshot: Memory) -> None:
        """Return to a snapshot."""
        self.memory = {name: value.clone() for name, value in snapshot.items() if name != "noise"}
        self.noise.seek(snapshot["noise"])
