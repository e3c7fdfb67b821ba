"""A person as the operator: the commands come from outside, one decision at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from wasp_cli.errors import UsageError
from wasp_cli.operators.base import (
    EpisodeNoise,
    Memory,
    NoiseSource,
    Operator,
    OperatorContext,
    Policy,
)
from wasp_cli.operators.cloned_person import ContinuedPerson
from wasp_cli.operators.clones import placed_clone


class PersonOperator(Operator):
    """See the module. In imagination the current command is held, since the person cannot be asked
    there.
    """

    def __init__(self, policy: Policy, action_size: int, noise: NoiseSource, batch: int) -> None:
        """Begin B = `batch` episodes; `policy` and `noise` are not read."""
        super().__init__(policy, action_size, noise, batch)
        self._next: Tensor | None = None
        self.imagined = False  # whether this is a fork

    @classmethod
    def build(  # type: ignore[override]
        cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int
    ) -> Operator:
        """Build the operator of a session; where a session is branched, the one that the
        participant's clone continues.
        """
        clone = placed_clone()
        if clone is not None and clone.said and isinstance(noise, EpisodeNoise):
            return ContinuedPerson.of(clone, noise.seeds, context, noise)
        return super().build(value, context, noise, batch)

    def initial(self, batch: int) -> Memory:
        """Return a memory [B, A] of neutral commands."""
        return {"held": torch.zeros(batch, self.action_size)}

    def say(self, command: Tensor) -> None:
        """Take the command [B, A] of the next decision."""
        self._next = command

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return the command [B, A] that was said for this decision; in imagination, the last one.

        Raises:
            UsageError: nothing was said for this decision.
        """
        if self.imagined:
            return self.memory["held"]
        if self._next is None:
            raise UsageError(
                "a person has to drive this cell: nobody's commands can be computed",
                "wasp drive TASK or SPEC; wasp clone RESULTS --participant N makes an "
                "operator of what was recorded",
            )
        issued = self._next
        self._next = None
        self.memory = {"held": issued}
        return issued

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> Operator:
        """Return the same operator in imagination, where the last command is held."""
        forked = super().fork(rows, copies, noise)
        assert isinstance(forked, PersonOperator)
        forked.imagined = True
        return forked
