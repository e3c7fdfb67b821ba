"""The contract of a simulated operator: an intended policy, an impairment with memory, and a source
of randomness.

The same class runs in the task (noise from the episode's stream) and in imagination (forked from
the real memory, with draws of its own), which is the paper's "same pi_H". B = rows, A = action
size, F = size of what the policy reads (latent features at evaluation, privileged observations
while data are collected), P = size of a privileged observation, H = steps of an imagination.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED

Policy = Callable[[Tensor], Tensor]  # [B, F] to a command [B, A] in [-1, 1]
Memory = dict[str, Tensor]  # tensors whose first dimension is B


class NoiseSource(Protocol):
    """Uniform draws for one decision of B rows at a time."""

    def next(self, size: int) -> Tensor:
        """Return uniforms in [0, 1), [B, size]; every call moves on by one decision."""
        ...

    def position(self) -> Tensor:
        """Return the position of the streams, as a tensor [...]; after `seek` of it the same draws
        follow.
        """
        ...

    def seek(self, position: Tensor) -> None:
        """Return to a position [...]."""
        ...


@dataclass(frozen=True)
class OperatorContext:
    """The parts of an operator variant besides its severity and its noise."""

    # the policy at a fraction of the expert's training (1.0 is the expert)
    skill: Callable[[float], Policy]
    action_size: int  # A
    decision_seconds: float  # seconds between two commands
    informed: Callable[[float], Policy] | None = None
    """The policy of privileged observations at a fraction of the expert's training, for operators
    who know more than any assistant perceives. None: operators perceive what assistants do.
    Imagination has `skill` alone.
    """


class Operator:
    """An unimpaired operator, and the base of the impaired ones."""

    noise_size: ClassVar[int] = 0  # uniforms per decision beyond those for an action
    # whether a decision also needs A uniforms for a random action
    draws_action: ClassVar[bool] = False

    def __init__(self, policy: Policy, action_size: int, noise: NoiseSource, batch: int) -> None:
        """Begin B = `batch` episodes.

        Args:
            policy: the intended commands.
            action_size: A.
            noise: of the impairment.
            batch: B.
        """
        self.policy = policy
        self.action_size = action_size
        self.noise = noise
        self.batch = batch
        self.memory = self.initial(batch)
        self.informed: Policy | None = None
        """The intended commands [B, A] for privileged observations [B, P]; None: `policy` gives
        them.
        """

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator of severity `value` for B = `batch` rows."""
        return cls.skilled(1.0, context, noise, batch)

    @classmethod
    def skilled(
        cls, fraction: float, context: OperatorContext, noise: NoiseSource, batch: int
    ) -> Self:
        """Build an operator with the skill at a fraction of the expert's training."""
        operator = cls(context.skill(fraction), context.action_size, noise, batch)
        if context.informed is not None:
            operator.informed = context.informed(fraction)
        return operator

    @property
    def knows_more(self) -> bool:
        """Whether commands in the task need privileged observations."""
        return self.informed is not None

    @property
    def draws(self) -> int:
        """Uniforms per decision and row."""
        if self.draws_action:
            return self.noise_size + self.action_size
        return self.noise_size

    def initial(self, batch: int) -> Memory:
        """Return the memory at the start of an episode: tensors [B, ...]."""
        return {}

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        """Return the issued command [B, A] and the next memory, for the intended command [B, A]
        and uniforms [B, draws].
        """
        return intended, memory

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return a^H [B, A] for what the operator sees now, [B, F]; memory and noise move on by one
        decision.

        An informed operator in the task reads privileged observations [B, P] instead; in
        imagination there are none.
        """
        intended = self.intended(features, privileged)
        uniforms = self.noise.next(self.draws).to(intended.device)
        issued, self.memory = self.act(intended, self.memory, uniforms)
        return issued

    def intended(self, features: Tensor, privileged: Tensor | None) -> Tensor:
        """Return the command [B, A] before the impairment."""
        if self.informed is None or privileged is None:
            return self.policy(features)
        return self.informed(privileged)

    def react(self, executed: Tensor, memory: Memory) -> Memory:
        """Return the next memory after `executed` [B, A] was carried out instead of the command;
        an unimpaired operator's does not change.
        """
        return memory

    def observe(self, executed: Tensor) -> None:
        """Tell the operator which action [B, A] was executed after its command; only the memory may
        change, by `react`.

        A loop that asks for commands calls it once after each of them, before the next one.
        """
        self.memory = self.react(executed, self.memory)

    def to(self, device: torch.device) -> Self:
        """Move the memory to another device; policies are moved by their owner."""
        self.memory = {name: value.to(device) for name, value in self.memory.items()}
        return self

    def reset(self, rows: Tensor) -> None:
        """Clear the memory of rows [B] (bool) for new episodes."""
        fresh = self.initial(self.batch)
        for name, old in self.memory.items():
            mask = rows.to(old.device).view(-1, *([1] * (old.dim() - 1)))
            self.memory[name] = torch.where(mask, fresh[name].to(old.device), old)

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> Operator:
        """Return the same operator in imagination: `copies` adjacent copies of each of `rows`
        (indices [R]), with other noise.
        """
        # A shallow copy, without the constructor.
        forked = object.__new__(type(self))
        forked.__dict__.update(self.__dict__)
        forked.noise = noise
        forked.batch = len(rows) * copies
        forked.memory = {
            name: value[rows].repeat_interleave(copies, 0) for name, value in self.memory.items()
        }
        return forked

    def snapshot(self) -> Memory:
        """Return memory and position of the noise: after `restore` of it the same commands
        follow, bit for bit.
        """
        snapshot = {"noise": self.noise.position()}
        for name, value in self.memory.items():
            snapshot[name] = value.clone()
        return snapshot

    def restore(self, snapshot: Memory) -> None:
        """Return to a snapshot."""
        self.memory = {name: value.clone() for name, value in snapshot.items() if name != "noise"}
        self.noise.seek(snapshot["noise"])


def build_operator(
    variant: str, value: float | None, context: OperatorContext, noise: NoiseSource, batch: int
) -> Operator:
    """Build an operator of `batch` rows; the variant "none" is the unimpaired expert."""
    if variant == UNIMPAIRED or value is None:
        return Operator.build(1.0, context, noise, batch)
    operator: Operator = OPERATORS.load(variant).build(value, context, noise, batch)
    return operator


class EpisodeNoise:
    """A counter-based stream per episode: what decision t of an episode draws depends on its seed
    and t alone.
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        """Begin an episode of each seed."""
        self.seeds = list(seeds)
        self.step = [0] * len(self.seeds)

    def restart(self, row: int, seed: int) -> None:
        """Begin a new episode in a row."""
        self.seeds[row] = seed
        self.step[row] = 0

    def next(self, size: int) -> Tensor:
        """Return uniforms [B, size] of the next decision of every episode."""
        draws = np.empty((len(self.seeds), size), np.float32)
        for row, (seed, step) in enumerate(zip(self.seeds, self.step, strict=True)):
            if size:
                # 2^64 draws lie between two counters of the second word, so that decisions never
                # share any.
                stream = np.random.Philox(key=seed, counter=[0, step, 0, 0])
                draws[row] = np.random.Generator(stream).random(size, np.float32)
            self.step[row] = step + 1
        return torch.from_numpy(draws)

    def position(self) -> Tensor:
        """Return the number of decisions [B] of each episode so far."""
        return torch.tensor(self.step)

    def seek(self, position: Tensor) -> None:
        """Return to a position [B]."""
        self.step = position.tolist()


class DrawnNoise:
    """Draws that were made before a loop. Rows may share draws, as views of the same ones (common
    random numbers).
    """

    def __init__(self, draws: Tensor) -> None:
        """Begin the loop; `draws` [H, B, K] are for H decisions of at most K draws."""
        self.draws = draws
        self.step = 0

    def next(self, size: int) -> Tensor:
        """Return the draws [B, size] of the next step of the loop."""
        drawn = self.draws[self.step, :, :size]
        self.step += 1
        return drawn

    def position(self) -> Tensor:
        """Return the step of the loop."""
        return torch.tensor(self.step)

    def seek(self, position: Tensor) -> None:
        """Return to a position."""
        self.step = int(position)
