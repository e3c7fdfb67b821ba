"""A person as the operator: commands come from outside, one decision at a time."""

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
    """See the module. In imagination the command of now is held: nobody can ask a person what
    they would do there.
    """

    def __init__(self, policy: Policy, action_size: int, noise: NoiseSource, batch: int) -> None:
        super().__init__(policy, action_size, noise, batch)
        self._next: Tensor | None = None
        self.imagined = False  # whether this is a fork

    @classmethod
    def build(  # type: ignore[override]
        cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int
    ) -> Operator:
        """Build the operator of a session; where a session is branched, one whom the
        participant's clone continues.
        """
        clone = placed_clone()
        if clone is not None and clone.said and isinstance(noise, EpisodeNoise):
            return ContinuedPerson.of(clone, noise.seeds, context, noise)
        return super().build(value, context, noise, batch)

    def initial(self, batch: int) -> Memory:
        return {"held": torch.zeros(batch, self.action_size)}

    def say(self, command: Tensor) -> None:
        """Take the command [B, A] of the next decision."""
        self._next = command

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return what was said for this decision, [B, A]; in imagination what was said last."""
        if self.imagined:
            return self.memory["held"]
        if self._next is None:
            raise UsageError(
                "a person has to drive this cell: nobody's commands can be computed",
                "wasp drive TASK or SPEC; wasp clone RESULTS --participant N makes an "
                "operator of what was recorded",
            )
        issued, self._next = self._next, None
        self.memory = {"held": issued}
        return issued

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> Operator:
        forked = super().fork(rows, copies, noise)
        assert isinstance(forked, PersonOperator)
        forked.imagined = True
        return forked
