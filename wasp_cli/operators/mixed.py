"""An operator that is a different variant in every episode: what SafeRL-Res trains with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from torch import Tensor

from wasp_cli.operators.base import Memory, NoiseSource, Operator


class MixedOperator(Operator):
    """B rows, each driven by one of several operators (all of batch B), chosen anew at every reset.

    All of them share one draw per decision and one evaluation of each distinct policy: only the
    chosen operator of a row counts. `choice` [B] may also be set: a row then meets the operator of
    that index until its next reset.
    """

    def __init__(self, operators: Sequence[Operator], noise: NoiseSource, seed: int) -> None:
        first = operators[0]
        super().__init__(first.policy, first.action_size, noise, first.batch)
        self.operators = list(operators)
        self._random = np.random.default_rng(seed)
        self.choice = torch.zeros(first.batch, dtype=torch.long)

    @property
    def knows_more(self) -> bool:
        return any(operator.knows_more for operator in self.operators)

    @property
    def draws(self) -> int:
        return max(operator.draws for operator in self.operators)

    def reset(self, rows: Tensor) -> None:
        """Begin new episodes in `rows` [B] (bool): clear memories and draw their operators."""
        drawn = torch.from_numpy(
            self._random.integers(len(self.operators), size=len(self.choice))
        ).to(self.choice.device)
        self.choice = torch.where(rows.to(self.choice.device), drawn, self.choice)
        for operator in self.operators:
            operator.reset(rows)

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return the commands [B, A] of the operators that drive the rows, at features [B, F]."""
        uniforms = self.noise.next(self.draws).to(features.device)
        intended: dict[int, Tensor] = {}
        issued = []
        for operator in self.operators:
            mind = id(operator.policy)  # one for each skill, informed or not
            if mind not in intended:
                intended[mind] = operator.intended(features, privileged)
            command, operator.memory = operator.act(
                intended[mind], operator.memory, uniforms[:, : operator.draws]
            )
            issued.append(command)
        return torch.stack(issued)[
            self.choice, torch.arange(len(self.choice), device=self.choice.device)
        ]

    def observe(self, executed: Tensor) -> None:
        """Tell all operators which action [B, A] was executed; what one makes of a row that it
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
        """Copy it into imagination, where every row keeps its operator, and operators of no row
        are left out.
        """
        used, choice = torch.unique(self.choice[rows], return_inverse=True)
        forked = object.__new__(type(self))
        forked.__dict__.update(self.__dict__)
        forked.noise, forked.batch = noise, len(rows) * copies
        forked.operators = [self.operators[i].fork(rows, copies, noise) for i in used.tolist()]
        forked.choice = choice.repeat_interleave(copies)
        return forked

    def snapshot(self) -> Memory:
        """Return the memories of all operators, by their index, and who drives which row."""
        memories = {
            f"{i}.{name}": value.clone()
            for i, each in enumerate(self.operators)
            for name, value in each.memory.items()
        }
        return {"noise": self.noise.position(), "choice": self.choice.clone(), **memories}

    def restore(self, snapshot: Memory) -> None:
        """Return to a snapshot."""
        for i, operator in enumerate(self.operators):
            operator.memory = {name: snapshot[f"{i}.{name}"].clone() for name in operator.memory}
        self.choice = snapshot["choice"].clone()
        self.noise.seek(snapshot["noise"])
