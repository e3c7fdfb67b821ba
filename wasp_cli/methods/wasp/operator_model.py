"""Who is imagined in the operator's place: what the planner assumes of the commands to come.

The paper's planner has the very rule and memory of the operator that it assists. An assistant of a person has not.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from wasp_cli.models.clone import Clone
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import DrawnNoise, Memory, Operator, Policy
from wasp_cli.operators.cloned import ClonedOperator


def imagined_operator(model: str, operator: Operator, a_h: Tensor, expert: Policy | None, clone: ClonedOperator | None = None) -> Operator:
    """Return the operator of B rows to imagine from here on, after the commands a_h [B, A].

    Args:
        model: `rule` (the operator itself, with its memory), `expert` (the unimpaired one), `hold` (the last command, held), or
            `cloned` (what was learned of its commands).
        operator: the one that has just issued the commands.
        a_h: the commands.
        expert: the nominal expert on latent features.
        clone: what was learned of the operator.

    Raises:
        ValueError: no expert or no clone to imagine.
    """
    if model == "rule":
        return operator
    batch, actions = a_h.shape
    nothing = DrawnNoise(torch.zeros(0, batch, 0))
    if model == "hold":
        held = HeldCommand(lambda features: features.new_zeros(len(features), actions), actions, nothing, batch)
        held.memory = {"held": a_h}
        return held
    if model == "cloned":
        if clone is None:
            raise ValueError("there is no clone to imagine in the operator's place")
        return clone.after(a_h, nothing)
    if expert is None:
        raise ValueError("there is no expert to imagine in the operator's place")
    return Operator(expert, actions, nothing, batch)


def load_clone(folder: Path, nominal: Policy, actions: int, device: torch.device | None = None) -> ClonedOperator:
    """Load the clone of an artifact of the stage `clone`; `nominal` is the policy that it corrects.

    Raises:
        ArtifactError: a file is missing or damaged.
    """
    clone = load_module(Clone, folder / "clone.safetensors").to(device)
    return ClonedOperator(clone, nominal, actions, DrawnNoise(torch.zeros(0, 0, 0)), 0)


class HeldCommand(Operator):
    """An operator that goes on with one command."""

    def initial(self, batch: int) -> Memory:
        return {"held": torch.zeros(batch, self.action_size)}

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        return memory["held"], memory
