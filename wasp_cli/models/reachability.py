"""The safety value Q(h, z, a) of a reachability analysis, and the fallback that acts by it.

B rows, F features, A size of an action, K actions of each row.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor, nn

# logit of the danger before training. A large one would last: the danger that every state seems to
# have at first spreads backwards through the targets.
SAFE = -3.0
MOST = 27  # largest number of actions that the fallback chooses from


class _Member(nn.Module):
    """One network. The part that depends on the state is computed once for all actions of a row."""

    def __init__(self, features: int, inputs: int, hidden: int) -> None:
        super().__init__()
        self.state = nn.Linear(features, hidden)
        self.action = nn.Linear(inputs, hidden, bias=False)
        self.rest = nn.Sequential(
            nn.LayerNorm(hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.LayerNorm(hidden),
            nn.SiLU(),
            nn.Linear(hidden, 1),
        )

    def forward(self, features: Tensor, scaled: Tensor) -> Tensor:
        """Return logits [B, K] at features [B, F] for actions at all scales, [B or 1, K, .]."""
        return self.rest(self.state(features).unsqueeze(-2) + self.action(scaled)).squeeze(-1)  # type: ignore[no-any-return]


class SafetyValue(nn.Module):
    """Q(h, z, a) in [-1, 1]: negative where failure cannot be avoided, the lower of two networks.

    A network predicts a danger d in [0, 1] by its logit, and Q = 1 - 2 d. A failure of probability
    c has the margin 1 - 2 c, so that values have the range of margins. Actions are read at several
    scales, as the world model reads them (`RSSM.scaled`).
    """

    scales: Tensor  # [scales, 1]
    extremes: Tensor  # [K, A] the actions that the fallback chooses from

    def __init__(
        self,
        features: int,
        action: int,
        hidden: int,
        action_scales: Sequence[float] = (1.0,),
        members: int = 2,
    ) -> None:
        """Build the networks.

        Args:
            features: F.
            action: A.
            hidden: width of the layers.
            action_scales: each value of an action is read as clip(a / s, -1, 1) for every scale s.
            members: number of networks.
        """
        super().__init__()
        networks = [_Member(features, len(action_scales) * action, hidden) for _ in range(members)]
        for network in networks:
            nn.init.constant_(network.rest[-1].bias, SAFE)  # type: ignore[arg-type]
        self.members = nn.ModuleList(networks)
        # Constructor arguments define both; they are not stored with the weights.
        self.register_buffer(
            "scales", torch.tensor(tuple(action_scales)).unsqueeze(-1), persistent=False
        )
        self.register_buffer("extremes", extreme_actions(action), persistent=False)

    def logits(self, features: Tensor, actions: Tensor) -> Tensor:
        """Return the logits of the danger [members, B, K] of actions [B or 1, K, A] at features
        [B, F].
        """
        scaled = (actions.unsqueeze(-2) / self.scales).clamp(-1, 1).flatten(-2)
        return torch.stack([member(features, scaled) for member in self.members])

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """Return Q [B, K] of actions [B or 1, K, A] at features [B, F]."""
        return 1 - 2 * self.logits(features, actions).amax(0).sigmoid()

    def fallback(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the safest of the extreme actions [B, A] and its value, V [B].

        Motors saturate, so that the safest action is all or nothing. No actor is needed to find
        it, and no gradient, which vanishes there.
        """
        values, index = self(features, self.extremes.unsqueeze(0)).max(-1)
        return self.extremes[index], values


def extreme_actions(size: int) -> Tensor:
    """Return the actions [K, A], A = `size`, that are -1, 0 or 1 in every component: all of them,
    or `MOST` of them, spread evenly, where there are more.
    """
    if 3**size <= MOST:
        return torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=size)))
    return (3 * torch.quasirandom.SobolEngine(size).draw(MOST)).floor().clamp(max=2) - 1


def danger_target(cost: Tensor, onward: Tensor, gamma: float) -> Tensor:
    """Return the target [...] of the danger: (1 - gamma) c + gamma max(c, d').

    The discounted safety Bellman equation (Fisac et al. 2019), Q = (1 - gamma) l + gamma min(l,
    V'), for l = 1 - 2 c and V' = 1 - 2 d'.

    Args:
        cost: [...] c, the probability of failure at the arrived state.
        onward: [...] d', the danger there under the fallback.
        gamma: discount per decision step.
    """
    return (1 - gamma) * cost + gamma * torch.maximum(cost, onward)
