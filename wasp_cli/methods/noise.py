"""An assistant's own randomness: what it draws at decision t depends on the episode's seed, on t,
and on the purpose of the draw alone, on any device.

B rows (episodes side by side), R of them selected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

CPU = torch.device("cpu")
AHEAD = 64  # decisions for which draws are made at once where another device needs them
MOST_BYTES = 256 * 1024**2  # that they may take together

# draws an array of a shape from a generator
Distribution = Callable[[np.random.Generator, Sequence[int]], np.ndarray]


class DecisionNoise:
    """Counter-based streams for B rows: `next` and `streams` return what the next decision of
    each of them draws from.
    """

    def __init__(self, device: torch.device = CPU) -> None:
        self.seeds: list[int] = []
        self.step: list[int] = []
        self.device = device
        self.ahead: dict[tuple[object, ...], Ahead] = {}  # by distribution, purpose and shapes
        self.taken = 0  # decisions since the last reset

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool), with one seed for each of the B rows."""
        if len(self.seeds) != len(seeds):
            self.seeds = list(seeds)
            self.step = [0] * len(seeds)
        for row, begins in enumerate(rows.tolist()):
            if begins:
                self.seeds[row] = seeds[row]
                self.step[row] = 0
        self.ahead = {}
        self.taken = 0

    def next(self) -> list[np.random.Generator]:
        """Return B generators for the next decision of every row."""
        return self.streams().generators()

    def streams(self) -> Streams:
        """Return the streams of the next decision of every row, one for each purpose."""
        streams = Streams(self, list(self.step), self.taken)
        self.step = [step + 1 for step in self.step]
        self.taken += 1
        return streams

    def draw(
        self,
        distribution: Distribution,
        step: Sequence[int],
        purpose: int,
        rows: Sequence[int],
        shapes: Sequence[Sequence[int]],
    ) -> list[Tensor]:
        """Draw for some rows: one tensor [len(rows), *shape] for each shape.

        Args:
            distribution: of the draws.
            step: [B] the decision of each row's episode.
            purpose: number of the stream.
            rows: which of the B rows.
            shapes: drawn one after the other from a row's stream.
        """
        drawn: list[list[np.ndarray]] = [[] for _ in shapes]  # by shape, then by row
        for row in rows:
            generator = _generator(self.seeds[row], step[row], purpose)
            for values, shape in zip(drawn, shapes, strict=True):
                values.append(distribution(generator, shape))
        return [torch.from_numpy(np.stack(values)) for values in drawn]

    def draw_ahead(
        self,
        distribution: Distribution,
        streams: Streams,
        purpose: int,
        shapes: Sequence[Sequence[int]],
    ) -> list[Tensor]:
        """Return what `draw` returns for all rows, [B, *shape] on the device, from draws that are
        made for many decisions at once.
        """
        key = (distribution, purpose, *map(tuple, shapes))
        ahead = self.ahead.get(key)
        if ahead is None or streams.taken not in ahead.decisions:
            # As many decisions as fit into the memory allowed, at least this one.
            size = 4 * len(self.seeds) * sum(int(np.prod(shape)) for shape in shapes)  # bytes
            count = max(1, min(AHEAD, MOST_BYTES // max(size, 1)))
            rows = range(len(self.seeds))
            by_decision = []
            for k in range(count):
                later = [step + k for step in streams.step]
                by_decision.append(self.draw(distribution, later, purpose, rows, shapes))
            ahead = Ahead(
                range(streams.taken, streams.taken + count),
                [torch.stack(values).to(self.device) for values in zip(*by_decision, strict=True)],
            )
            self.ahead[key] = ahead
        place = streams.taken - ahead.decisions.start
        return [values[place] for values in ahead.values]


class Ahead(NamedTuple):
    """Draws that are made for D decisions at once."""

    decisions: range  # their numbers since the last reset
    values: list[Tensor]  # [D, B, *shape] for each shape


class Streams(NamedTuple):
    """What one decision of B rows may draw: once for each purpose, from a stream of its own. A
    draw of one stream changes nothing in another.
    """

    noise: DecisionNoise
    step: list[int]  # [B] decision of the episode
    taken: int  # decisions since the noise was reset

    def generators(self, purpose: int = 0) -> list[np.random.Generator]:
        """Return a generator for each of the B rows."""
        return [
            _generator(seed, step, purpose)
            for seed, step in zip(self.noise.seeds, self.step, strict=True)
        ]

    def uniform(
        self, *shapes: Sequence[int], purpose: int = 0, rows: Tensor | None = None
    ) -> list[Tensor]:
        """Draw uniform variables in [0, 1), [R, *shape] for each shape, for `rows` (indices
        [R]) or all.
        """
        return self._drawn(_uniform, shapes, purpose, rows)

    def normal(self, *shape: int, purpose: int = 0, rows: Tensor | None = None) -> Tensor:
        """Draw standard normal variables [R, *shape] for `rows` (indices [R]) or all."""
        return self._drawn(_normal, [shape], purpose, rows)[0]

    def _drawn(
        self,
        distribution: Distribution,
        shapes: Sequence[Sequence[int]],
        purpose: int,
        rows: Tensor | None,
    ) -> list[Tensor]:
        noise = self.noise
        if noise.device.type == "cpu":
            selected = range(len(noise.seeds)) if rows is None else rows.tolist()
            return noise.draw(distribution, self.step, purpose, selected, shapes)
        values = noise.draw_ahead(distribution, self, purpose, shapes)
        if rows is None:
            return values
        return [each[rows] for each in values]


def _generator(seed: int, step: int, purpose: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, step, 1, purpose]))


def _uniform(generator: np.random.Generator, shape: Sequence[int]) -> np.ndarray:
    return generator.random(shape, np.float32)


def _normal(generator: np.random.Generator, shape: Sequence[int]) -> np.ndarray:
    return generator.standard_normal(shape, np.float32)


def normal(generators: Sequence[np.random.Generator], *shape: int) -> Tensor:
    """Draw standard normal variables [len(generators), *shape]."""
    return torch.from_numpy(np.stack([_normal(generator, shape) for generator in generators]))


def uniform(generators: Sequence[np.random.Generator], *shape: int) -> Tensor:
    """Draw uniform variables in [0, 1), [len(generators), *shape]."""
    return torch.from_numpy(np.stack([_uniform(generator, shape) for generator in generators]))


def gumbel(generators: Sequence[np.random.Generator], *shape: int) -> Tensor:
    """Draw standard Gumbel variables [len(generators), *shape]."""
    return as_gumbel(uniform(generators, *shape))


def as_gumbel(uniforms: Tensor) -> Tensor:
    """Convert uniform variables in [0, 1) to standard Gumbel variables of the same shape."""
    # The smallest positive float keeps both logarithms finite at a draw of 0.
    return -(-uniforms.clamp(1e-20, 1 - 1e-7).log()).log()
