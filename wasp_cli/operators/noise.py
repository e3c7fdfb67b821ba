"""Where an operator's randomness comes from: a stream per episode in the task, prepared draws in imagination."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor


class NoiseSource(Protocol):
    """Uniform draws for one decision of B rows at a time."""

    def next(self, size: int) -> Tensor:
        """Uniforms in [0, 1), [B, size]; every call moves on by one decision."""
        ...

    def position(self) -> Tensor:
        """Where the streams are, as a tensor; `seek` of it brings the same draws back."""
        ...

    def seek(self, position: Tensor) -> None: ...


class EpisodeNoise:
    """A counter-based stream per episode: what decision t of an episode draws depends on (its seed, t) and nothing else."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self.seeds = list(seeds)
        self.step = [0] * len(self.seeds)

    def restart(self, row: int, seed: int) -> None:
        """Begin a new episode in a row."""
        self.seeds[row], self.step[row] = seed, 0

    def next(self, size: int) -> Tensor:
        """[B, size]"""
        draws = np.empty((len(self.seeds), size), np.float32)
        for row, (seed, step) in enumerate(zip(self.seeds, self.step, strict=True)):
            if size:
                # 2^64 draws lie between two counters of the second word, so that decisions never share any.
                draws[row] = np.random.Generator(np.random.Philox(key=seed, counter=[0, step, 0, 0])).random(size, np.float32)
            self.step[row] = step + 1
        return torch.from_numpy(draws)

    def position(self) -> Tensor:
        """[B] decisions of each episode so far."""
        return torch.tensor(self.step)

    def seek(self, position: Tensor) -> None:
        """Return to a position."""
        self.step = position.tolist()


class DrawnNoise:
    """Draws made before a loop: [H, B, K]. Rows may share draws by having been expanded (common random numbers)."""

    def __init__(self, draws: Tensor) -> None:
        self.draws = draws
        self.step = 0

    def next(self, size: int) -> Tensor:
        """[B, size]"""
        drawn = self.draws[self.step, :, :size]
        self.step += 1
        return drawn

    def position(self) -> Tensor:
        """The step of the loop."""
        return torch.tensor(self.step)

    def seek(self, position: Tensor) -> None:
        """Return to a position."""
        self.step = int(position)
