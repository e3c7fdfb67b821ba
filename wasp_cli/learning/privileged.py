"""Episodes of a policy on privileged observations, without a camera."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.tasks.base import VectorTask


class EpisodeSums(NamedTuple):
    """Sums of whole episodes, one entry each."""

    returns: np.ndarray[Any, Any]
    costs: np.ndarray[Any, Any]  # env steps that cost
    costly: np.ndarray[Any, Any]  # decision steps that cost
    goals: np.ndarray[Any, Any]
    env_steps: np.ndarray[Any, Any]

    def statistics(self, success_goals: int) -> dict[str, float | None]:
        """Return means and standard deviations over the episodes (undefined for one), and the
        share with at least `success_goals` goals.
        """
        found: dict[str, float | None] = {}
        for name, values in (("return", self.returns), ("cost", self.costs), ("goals", self.goals)):
            found |= {
                name: float(values.mean()),
                f"{name}_sd": float(values.std(ddof=1)) if len(values) > 1 else None,
            }
        return found | {
            "cost_per_1000": float(1000.0 * self.costs.sum() / self.env_steps.sum()),
            "success": float((self.goals >= success_goals).mean()),
            "episodes": len(self.goals),
        }


def evaluate_privileged(
    task: VectorTask, policy: PrivilegedPolicy, seeds: list[int]
) -> EpisodeSums:
    """Run one episode per row under the deterministic policy."""
    seen = task.reset(seeds)
    sums = EpisodeSums(*(np.zeros(task.batch) for _ in EpisodeSums._fields))
    with torch.inference_mode():
        for _ in range(task.max_decisions):
            assert seen.privileged is not None
            step = task.step(policy(torch.from_numpy(seen.privileged)).numpy())
            seen = step.observation
            for total, now in zip(
                sums,
                (step.reward, step.cost_env, step.cost, step.goals, step.env_steps),
                strict=True,
            ):
                total += now
            if step.ended.all():
                break
    return sums
