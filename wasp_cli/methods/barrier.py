"""What filters by a control barrier function have in common: the condition on an action, and the
calibration of gamma.

    Q(h, z, a) >= gamma V(h, z)

is a discrete-time control barrier function over a state-action value (Oh et al. 2025): Q is a
learned safety value, V that of a fallback, and gamma the share of V that an action must keep. A
command that meets the condition stands. Elsewhere the nearest action that a filter finds is
executed. Nothing is imagined at a decision, and nothing is drawn.

B episodes, A actions, F features, N held-out decisions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from wasp_cli.methods.base import Decision, Heldout
from wasp_cli.methods.configs import QCBFConfig, ReachConfig
from wasp_cli.methods.quantiles import LOWER_TAIL, distributions
from wasp_cli.methods.record import blank_record, chosen
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator

CHUNK = 1024  # held-out decisions that are looked at together


class SafetyValues(NamedTuple):
    """What the condition is about, for B episodes."""

    fallback: Tensor  # [B, A] the action that is executed where none meets the condition
    value: Tensor  # [B] V
    command: Tensor  # [B] Q of the command


class BarrierFilter(ABC):
    """A filter by Q, V and a fallback. It remembers nothing between decisions.

    A subclass says where these come from (`_values`), and how an action is sought (`_nearest`).
    """

    config: QCBFConfig | ReachConfig
    gamma: float

    @abstractmethod
    def _values(self, features: Tensor, a_h: Tensor) -> SafetyValues:
        """Return V, the fallback, and Q of commands [B, A] at features [B, F]."""

    @abstractmethod
    def _nearest(self, features: Tensor, a_h: Tensor, fallback: Tensor, value: Tensor) -> Tensor:
        """Return the action [B, A] nearest to commands [B, A] of those found with Q >= gamma V;
        the fallback [B, A] where there is none.

        Args:
            features: [B, F].
            a_h: [B, A].
            fallback: [B, A].
            value: [B] V.
        """

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:  # noqa: B027
        """Do nothing: the filter remembers nothing of the rows [B]."""

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        """Return the commands a_h [B, A], filtered where they do not keep gamma V.

        The signal is by how much they fall short: gamma V - Q [B], above 0 where it intervenes.
        """
        features = latent.features
        values = self._values(features, a_h)
        shortfall = self.gamma * values.value - values.command  # [B]
        unsafe = shortfall > 0

        action = a_h.clone()
        record = blank_record(len(a_h), device=a_h.device)._replace(signal=shortfall)
        rows = chosen(unsafe)
        if len(rows):
            nearest = self._nearest(
                features[rows], a_h[rows], values.fallback[rows], values.value[rows]
            )
            action[rows] = torch.where(unsafe[rows].unsqueeze(-1), nearest, a_h[rows])
            record = record._replace(gate=(GATE_METHOD * unsafe).to(torch.int8))
        return Decision(action, record)

    def calibrate(
        self, heldout: Heldout, cost_ahead: Tensor, operator: Operator, seed: int
    ) -> dict[str, float]:
        """Set gamma to a quantile of Q / V of the expert, over decisions without cost after them;
        return it with the distributions.

        Args:
            heldout: N decisions of the expert.
            cost_ahead: [N] costly decisions among the W that begin with each; NaN where fewer are
                left in the episode.
            operator: not read.
            seed: not read.
        """
        # V and Q of the expert's commands.
        chunks = torch.arange(len(heldout.a_h), device=heldout.a_h.device).split(CHUNK)
        parts = [
            self._values(heldout.latent.rows(rows).features, heldout.a_h[rows]) for rows in chunks
        ]
        value = torch.cat([part.value for part in parts])  # [N]
        command = torch.cat([part.command for part in parts])

        # The share of V that they keep where nothing cost afterwards. Where V is negative no action
        # keeps a share of it.
        free = (cost_ahead == 0) & (value > 0)
        share = command[free] / value[free]
        if self.config.gamma == "calibrated" and len(share):
            self.gamma = float(torch.quantile(share, 1 - self.config.quantile).clamp(0, 1))
        return {
            "gamma": self.gamma,
            **distributions({"v": value, "kept_free": share}, LOWER_TAIL),
            "expert_rate": float((command < self.gamma * value).float().mean()),
        }
