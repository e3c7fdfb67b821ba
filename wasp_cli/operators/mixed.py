"""An operator that is a different variant in every episode: what SafeRL-Res trains with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, Operator


class MixedOperator(Operator):
    """B rows, each driven by one of several operators (all of batch B), drawn anew at every reset.

    All operators share one draw per decision and one evaluation of each distinct policy, since only
    one operator counts in a row. `choice` [B], their indices, may also be set: a row then meets the
    operator of that index until its next reset.
    """

    def __init__(self, operators: Sequence[Operator], noise: NoiseSource, seed: int) -> None:
        """Mix operators, at first the first one in every row; `seed` is that of later draws."""
        first = operators[0]
        super().__init__(first.policy, first.action_size, noise, first.batch)
        self.operators = list(operators)
        self._random = np.random.default_rng(seed)
        self.choice = torch.zeros(first.batch, dtype=torch.long)

    @property
    def knows_more(self) -> bool:
        """Whether the commands of any operator need privileged observations."""
        return any(operator.knows_more for operator in self.operators)

    @property
    def draws(self) -> int:
        """Uniforms per decision and row: as many as the operator that needs most."""
        return max(operator.draws for operator in self.operators)

    def reset(self, rows: Tensor) -> None:
        """Begin new episodes in `rows` [B] (bool): clear memories and draw their operators."""
        device = self.choice.device
        indices = self._random.integers(len(self.operators), size=len(self.choice))
        drawn = torch.from_numpy(indices).to(device)
        self.choice = torch.where(rows.to(device), drawn, self.choice)
        for operator in self.operators:
            operator.reset(rows)

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return the commands [B, A] of the operators that drive the rows, at features [B, F]."""
        uniforms = self.noise.next(self.draws).to(features.device)
        intended: dict[int, Tensor] = {}  # by the `id` of the policy, one for each skill
        commands = []
        for operator in self.operators:
            policy = id(operator.policy)
            if policy not in intended:
                intended[policy] = operator.intended(features, privileged)
            own_uniforms = uniforms[:, : operator.draws]
            command, operator.memory = operator.act(intended[policy], operator.memory, own_uniforms)
            commands.append(command)
        rows = torch.arange(len(self.choice), device=self.choice.device)
        return torch.stack(commands)[self.choice, rows]

    def observe(self, executed: Tensor) -> None:
        """Tell all operators which action [B, A] was executed. An operator's memory of rows that it
        does not drive is cleared by `reset`.
        """
        for operator in self.operators:
            operator.observe(executed)

    def to(self, device: torch.device) -> Self:
        """Move all memories to another device."""
        self.operators = [operator.to(device) for operator in self.operators]
        self.choice = self.choice.to(device)
        return self

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> MixedOperator:
        """Return the same operator in imagination, with other noise: every row keeps its operator,
        and operators of no row are left out.
        """
        used, choice = torch.unique(self.choice[rows], return_inverse=True)
        # A shallow copy, without the constructor.
        forked = object.__new__(type(self))
        forked.__dict__.update(self.__dict__)
        forked.noise = noise
        forked.batch = len(rows) * copies
        forked.operators = [self.operators[i].fork(rows, copies, noise) for i in used.tolist()]
        forked.choice = choice.repeat_interleave(copies)
        return forked

    def snapshot(self) -> Memory:
        """Return the memories of all operators, by their index, and the operator of each row."""
        snapshot = {"noise": self.noise.position(), "choice": self.choice.clone()}
        for i, operator in enumerate(self.operators):
            for name, value in operator.memory.items():
                snapshot[f"{i}.{name}"] = value.clone()
        return snapshot

    def restore(self, snapshot: Memory) -> None:
        """Return to a snapshot."""
        for i, operator in enumerate(self.operators):
            operator.memory = {name: snapshot[f"{i}.{name}"].clone() for name in operator.memory}
        self.choice = snapshot["choice"].clone()
        self.noise.seek(snapshot["noise"])
