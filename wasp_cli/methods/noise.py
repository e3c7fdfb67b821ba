"""An assistant's own randomness: what it draws at decision t of an episode depends on (the episode's seed, t) alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


class DecisionNoise:
    """Counter-based streams for B rows: `next` gives a generator of the draws of one decision for each of them."""

    def __init__(self) -> None:
        self.seeds: list[int] = []
        self.step: list[int] = []

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        if len(self.seeds) != len(seeds):
            self.seeds, self.step = list(seeds), [0] * len(seeds)
        for row in rows.nonzero().flatten().tolist():
            self.seeds[row], self.step[row] = seeds[row], 0

    def next(self) -> list[np.random.Generator]:
        """Return B generators for the next decision of every row."""
        generators = [
            np.random.Generator(np.random.Philox(key=seed, counter=[0, step, 1, 0]))
            for seed, step in zip(self.seeds, self.step, strict=True)
        ]
        self.step = [step + 1 for step in self.step]
        return generators


def normal(generators: Sequence[np.random.Generator], *shape: int) -> Tensor:
    """Draw standard normal variables [len(generators), *shape]."""
    return torch.from_numpy(np.stack([g.standard_normal(shape, np.float32) for g in generators]))


def uniform(generators: Sequence[np.random.Generator], *shape: int) -> Tensor:
    """Draw uniform variables in [0, 1), [len(generators), *shape]."""
    return torch.from_numpy(np.stack([g.random(shape, np.float32) for g in generators]))


def gumbel(generators: Sequence[np.random.Generator], *shape: int) -> Tensor:
    """Draw standard Gumbel variables [len(generators), *shape]."""
    # The smallest positive float keeps both logarithms finite at a draw of 0.
    u = uniform(generators, *shape).clamp(1e-20, 1 - 1e-7)
    return -(-u.log()).log()
