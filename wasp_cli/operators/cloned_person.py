"""The clone of a person as an operator: a policy that `wasp clone` fitted to the commands of a
participant, and the participant's session with the clone after it.
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
    """A participant's clone. The severity is the participant's number; the clone is the one that
    the node reads (`operators.clones`).
    """

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build the operator of B = `batch` episodes.

        Raises:
            UsageError: no clone is placed.
            ArtifactError: its weights cannot be read.
        """
        clone = load_module(Clone, required_clone().folder / "clone.safetensors")
        return cls(clone, context.skill(1.0), context.action_size, noise, batch)

    def to(self, device: torch.device) -> Self:
        """Move the clone and the memory to another device."""
        self.clone = self.clone.to(device)
        return super().to(device)


class ContinuedPerson(CloneOfPerson):
    """A person whose session is replayed, and whose clone goes on where a branch leaves it, since
    the person cannot be asked again.

    Until the first `restore` commands are the recorded ones; from then on they are drawn from the
    clone.
    """

    _recorded: Tensor  # [T, B, A] commands of the session
    _t: int  # decisions so far
    _branching: bool  # whether a branch has left the session

    @classmethod
    def of(
        cls, placed: PlacedClone, seeds: list[int], context: OperatorContext, noise: NoiseSource
    ) -> Self:
        """Build the operator of the episodes with these operator seeds, an episode in each row."""
        operator = cls.build(0.0, context, noise, len(seeds))
        length = max(len(placed.said[seed]) for seed in seeds)
        operator._recorded = torch.zeros(length, len(seeds), context.action_size)
        for row, seed in enumerate(seeds):
            commands = placed.said[seed]  # [T_e, A]
            operator._recorded[: len(commands), row] = torch.tensor(commands)
        operator._t = 0
        operator._branching = False
        return operator

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return the recorded commands [B, A] of this decision, or in a branch those of the
        clone.
        """
        if self._branching:
            return super().command(features, privileged)
        last = len(self._recorded) - 1
        issued = self._recorded[min(self._t, last)].to(features.device)
        self._t += 1
        # The clone would have drawn here, so that a branch goes on with the draws of its decision.
        self.noise.next(self.draws)
        self.memory = {"last": issued}
        return issued

    def restore(self, snapshot: Memory) -> None:
        """Return to a snapshot, from which the clone goes on."""
        self._branching = True
        super().restore(snapshot)
