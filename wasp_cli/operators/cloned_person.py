"""The clone of a person as an operator of the grid: what `wasp clone` fitted to the commands of
a participant drives.
"""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from wasp_cli.models.clone import Clone
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import Memory, NoiseSource, OperatorContext
from wasp_cli.operators.cloned import ClonedOperator
from wasp_cli.operators.clones import PlacedClone, required_clone


class CloneOfPerson(ClonedOperator):
    """See the module. Its severity is the participant's number; the clone is that which the
    node reads (`operators.clones`).
    """

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build the operator of B = `batch` episodes."""
        clone = load_module(Clone, required_clone().folder / "clone.safetensors")
        return cls(clone, context.skill(1.0), context.action_size, noise, batch)

    def to(self, device: torch.device) -> Self:
        self.clone = self.clone.to(device)
        return super().to(device)


class ContinuedPerson(CloneOfPerson):
    """A person whose session is played again, and whose clone goes on where a branch leaves it:
    nobody can be asked again.

    Until the first `restore` commands are those that were said; from then on they are drawn from
    the clone.
    """

    @classmethod
    def of(
        cls, placed: PlacedClone, seeds: list[int], context: OperatorContext, noise: NoiseSource
    ) -> Self:
        """Build the operator of the episodes with these operator seeds."""
        built = cls.build(0.0, context, noise, len(seeds))
        length = max(len(placed.said[seed]) for seed in seeds)
        built._said = torch.zeros(length, len(seeds), context.action_size)
        for row, seed in enumerate(seeds):
            said = placed.said[seed]
            built._said[: len(said), row] = torch.tensor(said)
        built._t, built._branching = 0, False
        return built

    _said: Tensor
    _t: int
    _branching: bool

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        if self._branching:
            return super().command(features, privileged)
        issued = self._said[min(self._t, len(self._said) - 1)].to(features.device)
        self._t += 1
        self.noise.next(self.draws)  # a branch draws what its decision would have drawn
        self.memory = {"last": issued}
        return issued

    def restore(self, snapshot: Memory) -> None:
        self._branching = True
        super().restore(snapshot)
