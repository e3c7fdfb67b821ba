"""Ensembles of small networks, evaluated as one batched product. K members, B rows, I inputs, O
outputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Ensemble(nn.Module):
    """K networks of the same shape, which see the same inputs and begin with weights of their
    own. Subclasses say what they read.
    """

    def __init__(
        self, members: int, inputs: int, hidden: Sequence[int], size: int, dropout: float = 0.0
    ) -> None:
        """Build K = `members` networks from I = `inputs` to O = `size` numbers.

        Args:
            members: K.
            inputs: I.
            hidden: widths of the hidden layers.
            size: O.
            dropout: probability that a hidden unit drops out in training.
        """
        super().__init__()
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for a, b in pairwise([inputs, *hidden, size]):
            bound = 1 / math.sqrt(a)
            self.weights.append(nn.Parameter(torch.empty(members, a, b).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(members, 1, b).uniform_(-bound, bound)))
        self.members = members
        self.dropout = dropout

    def outputs(self, inputs: Tensor) -> Tensor:
        """Return the outputs [K, B, O] of all members for inputs [B, I]; in training, hidden units
        drop out at random.
        """
        x = inputs.expand(self.members, -1, -1)
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if i < last:
                x = F.dropout(F.relu(x), self.dropout, self.training)
        return x


class QEnsemble(Ensemble):
    """K members Q_k(h, z, a) of F features and A actions."""

    def __init__(self, members: int, features: int, action: int, hidden: Sequence[int]) -> None:
        """Build K = `members` networks, with hidden layers of these widths."""
        super().__init__(members, features + action, hidden, 1)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the values [K, B] of actions [B, A] at features [B, F]."""
        return self.outputs(torch.cat([features, action], -1)).squeeze(-1)
