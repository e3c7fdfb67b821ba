"""The contract of an assistant: from a filtered latent and the operator's command to the executed
action.

The rows of the main table differ in the assistant alone: all of them get the same latents, commands
and models. B = episodes side by side, A = action size, F = features of a latent, K = held-out
decisions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor

from wasp_cli.config import Config
from wasp_cli.errors import WaspError
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.motors import UNKNOWN, Motors

if TYPE_CHECKING:
    # Training drives the task with assistants too. An import for types alone keeps the key of
    # training independent of the form of records.
    from wasp_cli.methods.record import Planned, Record


class Decision(NamedTuple):
    """What an assistant decided for B episodes."""

    # [B, A] to be executed, within [-1, 1]; where no gate fired, the command bit for bit
    action: Tensor
    # gates and signals (`methods.record`); None: every command stands, and nothing was computed
    record: Record | None = None
    planned: Planned | None = None  # the plans, of methods that plan


def checked(decision: object, assistant: object, a_h: Tensor, before: Tensor) -> Decision:
    """Return the decision of `assistant` on commands if it keeps its contract.

    Args:
        decision: what it returned.
        assistant: named in messages.
        a_h: [B, A] the commands that it was given, as they are now.
        before: [B, A] a copy of them from before the decision.

    Raises:
        WaspError: it changed the commands in place, it returned no `Decision`, an action has
            another shape, or a command was changed although no gate fired.
    """
    who = f"the assistant '{type(assistant).__name__}'"
    if not isinstance(decision, Decision):
        raise WaspError(
            f"{who} returned a {type(decision).__name__}, not a Decision",
            "return Decision(action, record) from `decide`",
        )
    if ((a_h != before) & ~before.isnan()).any():
        raise WaspError(
            f"{who} changed the operator's command in place",
            "let `decide` work on a_h.clone(), and return Decision(action, record)",
        )
    action = decision.action
    record = decision.record
    if action.shape != a_h.shape:
        raise WaspError(
            f"{who} returned actions of shape {list(action.shape)} for commands of shape "
            f"{list(a_h.shape)}"
        )
    changed = ((action != a_h) & ~a_h.isnan()).any(-1)  # [B]
    if record is None and changed.any():
        raise WaspError(
            f"{who} changed a command without a record",
            "return Decision(action, record) with the gate that fired",
        )
    if record is not None and (changed & (record.gate == 0)).any():
        raise WaspError(
            f"{who} changed a command although its record says that no gate fired",
            "set `gate` where it intervenes",
        )
    return decision


@dataclass(frozen=True)
class Parts:
    """What assistants are built from; frozen models shared by all of them."""

    # the RSSM with its heads (`models.base.WorldModel`): filter, imagine, reward, cost
    world_model: SafetyWorldModel
    # latent policies; `skills.expert(features)` [B, F] to [B, A] is the nominal expert
    skills: Skills
    inputs: Mapping[str, Path]  # artifact folders by stage kind, for what only one method reads
    # calibrated values by name (`tau_c`, `tau_r`, `tau_q`); empty for methods without any
    thresholds: Mapping[str, float]
    gamma_r: float  # discount of rewards per decision step
    gamma_c: float  # discount of costs per decision step
    lam: float  # lambda of the TD-lambda returns (Eq. 8)
    motors: Motors = UNKNOWN  # of the robot: which commands have the same force

    @property
    def device(self) -> torch.device:
        """Return where the models are, and where a method puts what it loads for itself."""
        return next(self.skills.parameters()).device


class Heldout(NamedTuple):
    """Decisions of the unimpaired expert on held-out seeds: T_e rows for episode e,
    concatenated to K rows.
    """

    latent: Latent  # [K, .] filtered
    a_h: Tensor  # [K, A] commands of the expert
    reward: Tensor  # [K] reward of the decision
    cost: Tensor  # [K] in {0, 1}: costly decision
    episode: Tensor  # [K] index of the episode
    # [K] in {0, 1}: the decision ended the episode by the task's own rule, not by the time limit
    terminal: Tensor


class Assistant(Protocol):
    """See the module. What an assistant remembers between decisions is cleared by `reset`."""

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool); `seeds` has one entry for each of the B rows
        and names the sampling streams.
        """
        ...

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Decide on commands a_h [B, A] (within [-1, 1]) in the latent states [B, .]; `operator`
        has just issued them.

        a_h is not to be changed in place; what is drawn depends on the seed of the episode and the
        decision alone (`methods.noise`). Where a person waits, an assistant that has an attribute
        `time_is_up` finds a callable in it: a long search calls it, and returns its best so far
        once it returns True.
        """
        ...


class AssistantClass(Protocol):
    """The target of a registry entry: a class, or a function."""

    def __call__(self, config: Config, parts: Parts) -> Assistant:
        """Build the assistant from its validated configuration and the frozen models."""
        ...


class CalibratedAssistant(Assistant, Protocol):
    """An assistant whose thresholds come from held-out decisions."""

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set the thresholds and return them by name, with whatever else is worth storing.

        Args:
            heldout: K decisions.
            cost_ahead: [K] costly decisions among the W that begin with each; NaN where fewer are
                left in the episode.
            operator: unimpaired, one row per held-out decision.
            seed: names the draws.
        """
        ...
