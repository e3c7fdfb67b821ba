"""The network of Careful, and its training on recorded episodes. N recorded rows, K examples, F
features, A actions.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from wasp_cli.learning.sampling import generator
from wasp_cli.metrics.windows import sums_ahead
from wasp_cli.models.nets import mlp


class Risk(nn.Module):
    """Logit [...] that cost follows within the window, of features [..., F] and action [..., A]."""

    def __init__(self, features, action, hidden):
        super().__init__()
        self.net = mlp(features + action, hidden, 1)

    def forward(self, features, action):
        return self.net(torch.cat([features, action], -1)).squeeze(-1)


def examples(recording, window):
    """Return rows [K] whose whole window lies within their episode, and whether it costs [K].

    Row t + 1 of a recording holds the action that was executed at the state of row t, and its cost.
    """
    # [N], NaN where the episode ends before
    ahead = sums_ahead(recording.cost, recording.episode, window)
    rows = np.flatnonzero(
        np.isfinite(ahead[1:]) & (recording.episode[1:] == recording.episode[:-1])
    )
    return rows, ahead[rows + 1] > 0


def train(risk, features_of, action, rows, costly, config, seed, progress):
    """Fit `risk` by cross-entropy; return its mean loss over the last updates.

    Args:
        risk: the network, changed in place.
        features_of: from rows [K] to features [K, F].
        action: [N, A] recorded actions, by arrival.
        rows: [K] to learn from.
        costly: [K] whether cost followed.
        config: `RiskConfig`.
        seed: of the batches.
        progress: told the finished share in [0, 1] and a line of text.
    """
    rows, costly = torch.from_numpy(rows), torch.from_numpy(costly).float()
    optimizer, source, losses = (
        torch.optim.Adam(risk.parameters(), lr=config.learning_rate),
        generator(seed),
        [],
    )
    for update in range(config.updates):
        pick = torch.randint(len(rows), (config.batch,), generator=source)
        loss = binary_cross_entropy_with_logits(
            risk(features_of(rows[pick]), action[rows[pick] + 1]), costly[pick]
        )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        if update % 100 == 0:
            progress(
                update / config.updates, f"update {update}/{config.updates}, loss {losses[-1]:.3f}"
            )
    return float(np.mean(losses[-100:]))
