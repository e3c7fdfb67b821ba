"""Latent policies held against the privileged one on the same episodes, and which round of
training is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.learning.configs.latent import PoliciesConfig

Sums = NDArray[Any]


class Drive(NamedTuple):
    """Means over evaluation episodes, with what tells how far they can be trusted."""

    return_: float
    cost: float  # env steps that cost, per episode
    goals: float
    success: float  # share of the episodes with enough goals
    return_sd: float = 0.0  # standard deviation over the episodes
    cost_sd: float = 0.0
    episodes: int = 0
    env_steps: float = 0.0  # length of an episode
    returns: tuple[float, ...] = ()  # return of every episode

    def shown(self) -> dict[str, float]:
        """Return the means by the names that people read."""
        return {
            name.rstrip("_"): value for name, value in self._asdict().items() if name != "returns"
        }

    @classmethod
    def of(cls, returns: Sums, costs: Sums, goals: Sums, enough: int, env_steps: Sums) -> Drive:
        """Take means over the sums [B] of whole episodes; `enough` goals are a success."""
        means = (
            float(returns.mean()),
            float(costs.mean()),
            float(goals.mean()),
            float((goals >= enough).mean()),
        )
        return cls(
            *means,
            float(returns.std()),
            float(costs.std()),
            len(returns),
            float(env_steps.mean()),
            tuple(returns.tolist()),
        )


class Verdict(NamedTuple):
    """A latent policy beside the privileged one on the same episodes."""

    return_share: float
    """Latent return / privileged return; 1 plus the difference in units of its size where the
    privileged return is not positive.
    """
    # latent cost / privileged cost; None where the privileged policy cost nothing
    cost_ratio: float | None
    excess_cost: float  # cost per episode beyond what is allowed; 0 within it
    shortfall: float
    """The lacking share of the wanted return plus the excess cost in units of the allowed one;
    0 where both are reached.
    """
    reached: bool  # enough return and no excess cost
    return_share_se: float | None = None
    """Standard error of the share over the episodes, which both policies drove; None for a
    single one.
    """


def compare(latent: Drive, privileged: Drive, config: PoliciesConfig, env_steps: int) -> Verdict:
    """Hold a latent policy against the privileged one.

    The allowed cost is `cost_ratio` times the privileged cost, or the privileged cost plus
    `cost_allowance` per 1000 env steps if that is more: a ratio to almost nothing says nothing.
    `env_steps` is the time limit of an episode.
    """
    size = max(abs(privileged.return_), 1e-9)
    share = 1.0 + (latent.return_ - privileged.return_) / size
    allowed = max(
        config.cost_ratio * privileged.cost,
        privileged.cost + _allowance(config) * env_steps / 1000,
    )
    excess = max(0.0, latent.cost - allowed)
    ratio = latent.cost / privileged.cost if privileged.cost > 0 else None
    lacking = 0.0 if share >= config.return_share else 1.0 - share / config.return_share
    shortfall = lacking + excess / max(allowed, 1.0)
    return Verdict(
        share, ratio, excess, shortfall, shortfall == 0.0, _share_error(latent, privileged, share)
    )


def _allowance(config: PoliciesConfig) -> float:
    if config.cost_allowance == "auto":
        raise ValueError("the cost allowance is no number yet")
    return config.cost_allowance


def _share_error(latent: Drive, privileged: Drive, share: float) -> float | None:
    """Standard error of the share of two means over the same episodes, to first order (the
    delta method).
    """
    count, mean = len(latent.returns), privileged.return_
    if count < 2 or count != len(privileged.returns) or mean == 0:
        return None
    # the share itself where the privileged return is positive
    slope = 1.0 + np.sign(mean) * (share - 1.0)
    rest = np.array(latent.returns) - slope * np.array(privileged.returns)
    return float(rest.std(ddof=1) / count**0.5 / abs(mean))


def cost_limit(
    taught: Sequence[Drive], env_steps: float, config: PoliciesConfig, limit: int
) -> float:
    """Return what a reinforced policy may cost per 1000 env steps: per episode the privileged cost,
    and half of what `compare` allows.

    Args:
        taught: batches of episodes of the privileged expert, equally many in each.
        env_steps: length of an episode of the latent expert, from which the reinforcement starts;
            one that takes longer than its teacher must cost less per step.
        limit: the time limit of an episode in env steps.

    Returns:
        At least 1: the multiplier follows the excess in units of the limit.
    """
    cost, length = (
        float(np.mean([getattr(drive, name) for drive in taught])) for name in ("cost", "env_steps")
    )
    allowed = cost + 0.5 * _allowance(config) * limit / 1000
    return max(1.0, 1000 * allowed / max(length, env_steps))


def best_round(verdicts: Sequence[Verdict]) -> int:
    """Choose the first round that reached both; where none did the one that fell least short.

    Return and cost weigh alike: by the cost alone a policy that hardly moves would win.
    """
    return min(range(len(verdicts)), key=lambda number: verdicts[number].shortfall)
