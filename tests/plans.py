"""Invented episodes, and plans for them."""

from dataclasses import fields
from typing import Any

import numpy as np

from wasp_cli.metrics.episode import Plans, Trajectory

ITERATIONS, STEPS, ACTIONS = 4, 3, 2


def plans_of(share: Any, safe: int = 17) -> Plans:
    """Plans whose share of iterations in Case II is `share` [T], a multiple of a quarter;
    nothing was planned where it is NaN.
    """
    share = np.asarray(share, np.float64)
    nothing = np.isnan(share)
    in_case2 = np.arange(ITERATIONS) < (ITERATIONS * np.nan_to_num(share))[:, None]
    numbers = np.where(nothing, np.nan, np.arange(len(share)) / 8)
    return Plans(
        residuals=np.where(
            nothing[:, None, None], np.nan, np.arange(STEPS * ACTIONS).reshape(STEPS, ACTIONS) / 4
        ),
        safe=np.where(nothing[:, None], -1, np.full((len(share), ITERATIONS), safe)),
        case2=in_case2 & ~nothing[:, None],
        cost=numbers,
        reward=1 + numbers,
        alone_cost=2 + numbers,
        alone_reward=3 + numbers,
    )


def joined(parts: list[Plans]) -> Plans:
    """One after the other."""
    return Plans(
        **{
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Plans)
        }
    )


def trajectory(steps: int = 4, **changes: Any) -> Trajectory:
    """Four quiet steps unless told otherwise."""
    given: dict[str, Any] = {
        "reward": np.zeros(steps),
        "cost": np.zeros(steps, bool),
        "cost_env": np.zeros(steps, int),
        "env_steps": np.full(steps, 4),
        "goals": np.zeros(steps, int),
        "a_h": np.zeros((steps, 2)),
        "a": np.zeros((steps, 2)),
        "gate": np.zeros(steps, np.int8),
        **dict.fromkeys(("g_cost", "g_return", "delta_g", "signal"), np.full(steps, np.nan)),
    }
    plans = changes.pop("plans", None)
    return Trajectory(
        **(given | {name: np.asarray(value) for name, value in changes.items()}), plans=plans
    )
