"""Latent policies compared with the privileged one on the same episodes, and the choice of the
round of training that is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wasp_cli.learning.configs.latent import PoliciesConfig

Sums = NDArray[Any]


class Drive(NamedTuple):
    """Means over evaluation episodes, with what their precision follows from."""

    return_: float
    cost: float  # env steps that cost, per episode
    goals: float
    success: float  # share of the episodes with enough goals
    return_sd: float = 0.0  # standard deviation over the episodes
    cost_sd: float = 0.0
    episodes: int = 0
    env_steps: float = 0.0  # mean length of an episode
    returns: tuple[float, ...] = ()  # return of every episode

    def shown(self) -> dict[str, float]:
        """Return all numbers but `returns`, by name; `return_` is called `return`."""
        fields = self._asdict()
        del fields["returns"]
        return {name.rstrip("_"): value for name, value in fields.items()}

    @classmethod
    def of(cls, returns: Sums, costs: Sums, goals: Sums, enough: int, env_steps: Sums) -> Drive:
        """Take the means over the sums [B] of whole episodes; `enough` goals are a success."""
        return cls(
            return_=float(returns.mean()),
            cost=float(costs.mean()),
            goals=float(goals.mean()),
            success=float((goals >= enough).mean()),
            return_sd=float(returns.std()),
            cost_sd=float(costs.std()),
            episodes=len(returns),
            env_steps=float(env_steps.mean()),
            returns=tuple(returns.tolist()),
        )


class Verdict(NamedTuple):
    """How a latent policy compares with the privileged one on the same episodes."""

    return_share: float
    """1 + (latent return - privileged return) / |privileged return|. Where the privileged return is
    positive, this is latent return / privileged return.
    """
    cost_ratio: float | None
    """Latent cost / privileged cost; None where the privileged policy cost nothing."""
    excess_cost: float  # cost per episode above what is allowed; 0 within it
    shortfall: float
    """The missing share of the required return, plus the excess cost in units of the allowed cost;
    0 where both are reached.
    """
    reached: bool  # enough return and no excess cost
    return_share_se: float | None = None
    """Standard error of the share over the episodes, which both policies drove; None for a
    single episode.
    """


def compare(latent: Drive, privileged: Drive, config: PoliciesConfig, env_steps: int) -> Verdict:
    """Compare a latent policy with the privileged one.

    The allowed cost is `cost_ratio` times the privileged cost, or the privileged cost plus
    `cost_allowance` per 1000 env steps if that is more, because a ratio to almost nothing means
    little.

    Args:
        latent: drive of the latent policy.
        privileged: drive of the privileged one in the same episodes.
        config: what is required and allowed; its allowance is a number.
        env_steps: time limit of an episode.
    """
    size = max(abs(privileged.return_), 1e-9)
    share = 1.0 + (latent.return_ - privileged.return_) / size
    allowed = max(
        config.cost_ratio * privileged.cost,
        privileged.cost + _allowance(config) * env_steps / 1000,
    )
    excess = max(0.0, latent.cost - allowed)
    ratio = latent.cost / privileged.cost if privileged.cost > 0 else None
    missing = 0.0 if share >= config.return_share else 1.0 - share / config.return_share
    shortfall = missing + excess / max(allowed, 1.0)
    return Verdict(
        return_share=share,
        cost_ratio=ratio,
        excess_cost=excess,
        shortfall=shortfall,
        reached=shortfall == 0.0,
        return_share_se=_share_error(latent, privileged, share),
    )


def _allowance(config: PoliciesConfig) -> float:
    """Return the allowance; ValueError where it is `auto`, which the caller has to replace."""
    if config.cost_allowance == "auto":
        raise ValueError("policies.cost_allowance is still 'auto': replace it by a number first")
    return config.cost_allowance


def _share_error(latent: Drive, privileged: Drive, share: float) -> float | None:
    """Return the standard error of the share of two means over the same episodes, to first order
    (the delta method); None where it is undefined.
    """
    count = len(latent.returns)
    mean = privileged.return_
    if count < 2 or count != len(privileged.returns) or mean == 0:
        return None
    # Where the privileged return is positive, the slope is the share itself.
    slope = 1.0 + np.sign(mean) * (share - 1.0)
    residuals = np.array(latent.returns) - slope * np.array(privileged.returns)
    return float(residuals.std(ddof=1) / count**0.5 / abs(mean))


def cost_limit(
    teacher: Sequence[Drive], env_steps: float, config: PoliciesConfig, limit: int
) -> float:
    """Return what a reinforced policy may cost per 1000 env steps: in an episode as much as the
    privileged expert, and half of the allowance of `compare`.

    Args:
        teacher: batches of episodes of the privileged expert, equally many in each.
        env_steps: mean length of an episode of the latent expert from which the reinforcement
            starts. One that takes longer than its teacher has to cost less per step.
        config: the allowance, as a number.
        limit: the time limit of an episode in env steps.

    Returns:
        The limit, at least 1: the multiplier follows the excess in units of it.
    """
    cost = float(np.mean([drive.cost for drive in teacher]))
    length = float(np.mean([drive.env_steps for drive in teacher]))
    allowed = cost + 0.5 * _allowance(config) * limit / 1000
    return max(1.0, 1000 * allowed / max(length, env_steps))


def best_round(verdicts: Sequence[Verdict]) -> int:
    """Return the number of the first round that reached return and cost, or where none did, of the
    one with the smallest shortfall.

    The shortfall weighs return and cost alike: by the cost alone a policy that hardly moves would
    win.
    """
    return min(range(len(verdicts)), key=lambda number: verdicts[number].shortfall)
