"""Who is imagined in the operator's place: what the planner assumes of the commands to come.

The paper's planner has the very rule and memory of the operator that it assists. An assistant of a person has not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from wasp_cli.operators.base import DrawnNoise, Memory, Operator, Policy


def imagined_operator(model: str, operator: Operator, a_h: Tensor, expert: Policy | None) -> Operator:
    """Return the operator of B rows to imagine from here on, after the commands a_h [B, A].

    Args:
        model: `rule` (the operator itself, with its memory), `expert` (the unimpaired one), or `hold` (the last command, held).
        operator: the one that has just issued the commands.
        a_h: the commands.
        expert: the nominal expert on latent features.

    Raises:
        ValueError: no expert to imagine.
    """
    if model == "rule":
        return operator
    batch, actions = a_h.shape
    nothing = DrawnNoise(torch.zeros(0, batch, 0))
    if model == "hold":
        held = HeldCommand(lambda features: features.new_zeros(len(features), actions), actions, nothing, batch)
        held.memory = {"held": a_h}
        return held
    if expert is None:
        raise ValueError("there is no expert to imagine in the operator's place")
    return Operator(expert, actions, nothing, batch)


class HeldCommand(Operator):
    """An operator that goes on with one command."""

    def initial(self, batch: int) -> Memory:
        return {"held": torch.zeros(batch, self.action_size)}

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        return memory["held"], memory
