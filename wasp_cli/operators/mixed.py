"""An operator that is a different variant in every episode: what SafeRL-Res trains with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from wasp_cli.operators.base import Operator
from wasp_cli.operators.noise import NoiseSource


class MixedOperator:
    """B rows, each driven by one of several operators (all of batch B), chosen anew at every reset.

    All of them share one draw per decision and one evaluation of each distinct policy: only the chosen operator of a row counts.
    """

    def __init__(self, operators: Sequence[Operator], noise: NoiseSource, seed: int) -> None:
        self.operators = list(operators)
        self.noise = noise
        self._random = np.random.default_rng(seed)
        self._draws = max(operator.draws for operator in operators)
        self.choice = torch.zeros(operators[0].batch, dtype=torch.long)

    def reset(self, rows: Tensor) -> None:
        """New episodes in `rows` [B] (bool): clear memories and draw their operators."""
        drawn = torch.from_numpy(self._random.integers(len(self.operators), size=len(self.choice)))
        self.choice = torch.where(rows, drawn, self.choice)
        for operator in self.operators:
            operator.reset(rows)

    def command(self, features: Tensor) -> Tensor:
        """[B, A]"""
        uniforms = self.noise.next(self._draws)
        intended: dict[int, Tensor] = {}
        issued = []
        for operator in self.operators:
            policy = id(operator.policy)
            if policy not in intended:
                intended[policy] = operator.policy(features)
            command, operator.memory = operator.act(intended[policy], operator.memory, uniforms[:, : operator.draws])
            issued.append(command)
        return torch.stack(issued)[self.choice, torch.arange(len(self.choice))]
