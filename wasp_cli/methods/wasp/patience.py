"""For how long a search may wait at the expense of the task where no plan is safe.

Every plan corrects L decisions and lets the expert go on. Where the way itself costs, the plan that
costs least is to wait: the cost moves behind the horizon, and at the next decision it is moved
again. What a whole horizon of waiting has not avoided is not avoided by more of it. Where all that
time the expert's action would have gained tau_r, it is executed for as many decisions, or until its
future is safe.
"""

from __future__ import annotations

import torch
from torch import Tensor


class Patience:
    """How long each of B episodes has waited, and for how many decisions its expert goes on."""

    def __init__(self, limit: int | None) -> None:
        """Begin with nobody waiting.

        Args:
            limit: decisions in a row that are waited before the expert goes on, and for how many it
                does at most; None waits forever.
        """
        self.limit = limit
        self.waited = torch.zeros(0, dtype=torch.long)  # [B] decisions in a row
        self.going = torch.zeros(0, dtype=torch.long)  # [B] decisions that are left

    def reset(self, rows: Tensor) -> None:
        """Forget the episodes of `rows` [B] (bool), which begin."""
        if self.waited.shape != rows.shape:
            self.waited = torch.zeros(len(rows), dtype=torch.long, device=rows.device)
            self.going = torch.zeros_like(self.waited)
        self.waited = torch.where(rows, 0, self.waited)
        self.going = torch.where(rows, 0, self.going)

    def is_over(self, here: Tensor) -> Tensor:
        """Return at which of the decisions `here` (indices [R]) the expert goes on, where neither
        its action nor the command is safe: bool [R].
        """
        return self.going[here] > 0

    def count(self, here: Tensor, unsafe: Tensor, waits: Tensor) -> None:
        """Count a decision.

        Args:
            here: indices [R].
            unsafe: bool [R] neither the command nor the expert's action is safe.
            waits: bool [R] a search found no safe plan, and what it found returns less than the
                expert's action.
        """
        if self.limit is None:
            return
        # A future that is safe again ends both: the wait, and that the expert goes on.
        waited = torch.where(waits, self.waited[here] + 1, 0)
        going = torch.where(unsafe, (self.going[here] - 1).clamp(min=0), 0)
        over = waited >= self.limit
        self.waited[here] = torch.where(over, 0, waited)
        self.going[here] = torch.where(over, self.limit, going)
