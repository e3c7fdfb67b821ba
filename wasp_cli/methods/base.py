"""The contract of an assistant: from a filtered latent and the operator's command to the executed action.

Everything that the main table compares differs only here. B = episodes side by side, A = action size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import Operator

if TYPE_CHECKING:
    # Training drives the task with assistants too, and must not run again when decisions leave more behind.
    from wasp_cli.methods.record import Planned, Record


class Decision(NamedTuple):
    """What an assistant decided for B episodes."""

    action: Tensor
    """[B, A] to be executed, within the bounds"""
    record: Record | None = None
    """what there is to say of it; None: the commands stand, and nothing was computed"""
    planned: Planned | None = None
    """the plans, of methods that plan"""


@dataclass(frozen=True)
class Parts:
    """What assistants are built from; frozen models shared by all of them."""

    world_model: SafetyWorldModel
    skills: Skills
    inputs: Mapping[str, Path]
    """Artifact folders by stage kind, for what only one method reads."""
    thresholds: Mapping[str, float]
    """Calibrated values by name (`tau_c`, `tau_r`, `tau_q`); empty for methods without any."""
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
