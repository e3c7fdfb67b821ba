"""The contract of an assistant: from a filtered latent and the operator's command to the executed action.

Everything that the main table compares differs only here. B = episodes side by side, A = action size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.metrics.episode import GATE_NONE
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import Operator


class Record(NamedTuple):
    """What a decision leaves behind, the same fields for every method; NaN (-1 for `safe`) where undefined."""

    gate: Tensor
    """int8 [B]"""
    g_cost: Tensor
    """[B] nominal cost return of the safety gate (Eq. 9)"""
    delta_g: Tensor
    """[B] gain of the task gate (Eq. 12)"""
    signal: Tensor
    """[B] the method's own decision signal (IDA: ensemble vote)"""
    safe: Tensor
    """int16 [B] |F_s| of the last iteration (Eq. 14)"""
    case2_share: Tensor
    """[B] share of the iterations that were in Case II"""


class Decision(NamedTuple):
    """The executed action [B, A], within the bounds, and its record."""

    action: Tensor
    record: Record


def blank_record(batch: int, gate: int = GATE_NONE) -> Record:
    """A record with every optional field undefined."""
    nan = torch.full((batch,), torch.nan)
    return Record(
        torch.full((batch,), gate, dtype=torch.int8), nan.clone(), nan.clone(), nan.clone(),
        torch.full((batch,), -1, dtype=torch.int16), nan.clone(),
    )  # fmt: skip


@dataclass(frozen=True)
class Parts:
    """What assistants are built from; frozen models shared by all of them."""

    world_model: SafetyWorldModel
    skills: Skills
    inputs: Mapping[str, Path]
    """Artifact folders by stage kind, for what only one method reads."""
    thresholds: Mapping[str, float]
    """Calibrated values by name (`tau_r`, `tau_q`); empty for methods without any."""
    gamma_r: float
    gamma_c: float
    lam: float


class Heldout(NamedTuple):
    """Decisions of the unimpaired expert on held-out seeds: T_e rows for episode e, concatenated to K rows."""

    latent: Latent
    a_h: Tensor
    """[K, A]"""
    reward: Tensor
    """[K] reward of the decision"""
    cost: Tensor
    """[K] in {0, 1}: costly decision"""
    episode: Tensor
    """[K] index of the episode"""
    terminal: Tensor
    """[K] in {0, 1}: the decision ended the episode by the task's own rule, not by the time limit"""


class Assistant(Protocol):
    """See the module. Assistants keep state between decisions only through `reset`-able fields."""

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """New episodes in `rows` [B] (bool); `seeds` has one entry for each of the B rows and names the sampling streams."""
        ...

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """The action for commands a_h [B, A] (already within bounds); `operator` has just issued them."""
        ...


class AssistantClass(Protocol):
    """What a registry entry's target offers."""

    def __call__(self, config: Config, parts: Parts) -> Assistant: ...


class CalibratedAssistant(Assistant, Protocol):
    """An assistant whose thresholds come from held-out decisions."""

    def calibrate(self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int) -> dict[str, float]:
        """Thresholds by name.

        Args:
            heldout: K decisions.
            cost_ahead: [K] costly decisions among the W that begin with each; NaN where fewer are left in the episode.
            operator: unimpaired, one row per held-out decision.
            seed: names the draws.
        """
        ...
