"""The safety value Q(h, z, a) of a reachability analysis, and the fallback that acts by it. B
rows, F features, A actions, K actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor, nn

# logit of the danger before training: what every state seems to risk at first spreads backwards for
# long
SAFE = -3.0
MOST = 27  # actions at most that the fallback chooses from


class _Member(nn.Module):
    """One network: what is of the state is worked out once, however many actions are asked
    about.
    """

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
        """Return logits [B, K]."""
        return self.rest(self.state(features).unsqueeze(-2) + self.action(scaled)).squeeze(-1)  # type: ignore[no-any-return]


class SafetyValue(nn.Module):
    """Q(h, z, a) in [-1, 1]: negative where failure cannot be avoided, the lower of two networks.

    A network says a danger d, the logit of a probability, and Q = 1 - 2 d: so the margin of a
    failure of probability c is 1 - 2 c, and a value is never outside of what margins can be.
    Actions are read at several scales, as the world model reads them (`RSSM.scaled`).
    """

    scales: Tensor
    extremes: Tensor  # [K, A] what the fallback chooses from

    def __init__(
        self,
        features: int,
        action: int,
        hidden: int,
        action_scales: Sequence[float] = (1.0,),
        members: int = 2,
    ) -> None:
        super().__init__()
        made = [_Member(features, len(action_scales) * action, hidden) for _ in range(members)]
        for member in made:
            nn.init.constant_(member.rest[-1].bias, SAFE)  # type: ignore[arg-type]
        self.members = nn.ModuleList(made)
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

        Motors saturate, so that the safest action is all or nothing; no actor is needed to find it,
        nor its gradient, which vanishes there.
        """
        values, index = self(features, self.extremes.unsqueeze(0)).max(-1)
        return self.extremes[index], values


def extreme_actions(size: int) -> Tensor:
    """Return the actions [K, A] that are full or nothing in every component: all of them, or a
    spread of `MOST` where there are more.
    """
    if 3**size <= MOST:
        return torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=size)))
    return (3 * torch.quasirandom.SobolEngine(size).draw(MOST)).floor().clamp(max=2) - 1


def danger_target(cost: Tensor, onward: Tensor, gamma: float) -> Tensor:
    """Return the target [...] of the danger: (1 - gamma) c + gamma max(c, d').

    The discounted safety Bellman equation (Fisac et al. 2019), Q = (1 - gamma) l + gamma min(l,
    V'), for l = 1 - 2 c and V' = 1 - 2 d'.

    Args:
        cost: [...] probability of failure at the arrived state.
        onward: [...] the danger there under the fallback.
        gamma: discount per decision step.
    """
    return (1 - gamma) * cost + gamma * torch.maximum(cost, onward)
