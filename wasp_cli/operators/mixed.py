"""An operator that is a different variant in every episode: what SafeRL-Res trains with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from wasp_cli.operators.base import Operator


class MixedOperator:
    """B rows, each driven by one of several operators (all of batch B), chosen anew at every reset."""

    def __init__(self, operators: Sequence[Operator], seed: int) -> None:
        self.operators = list(operators)
        self._random = np.random.default_rng(seed)
        self.choice = torch.zeros(operators[0].batch, dtype=torch.long)

    def reset(self, rows: Tensor) -> None:
        """New episodes in `rows` [B] (bool): clear memories and draw their operators."""
        drawn = torch.from_numpy(self._random.integers(len(self.operators), size=len(self.choice)))
        self.choice = torch.where(rows, drawn, self.choice)
        for operator in self.operators:
            operator.reset(rows)

    def command(self, features: Tensor) -> Tensor:
        """[B, A]"""
        commands = torch.stack([operator.command(features) for operator in self.operators])  # [K, B, A]
        return commands[self.choice, torch.arange(len(self.choice))]
