"""The worlds as a batch for the closed loop (`wasp_cli.tasks.base.VectorTask`): the state is
observed, the goal is privileged.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.external.lander import GOAL_SIZE, SEEN, STEPS, GoalLander, Kind
from wasp_cli.tasks.base import Bools, Observation, Step


class LanderTask:
    """B episodes. The cost is a crash, a goal is the pad or the target; a decision is one step."""

    action_size, action_repeat, decision_seconds, max_decisions = 2, 1, 0.02, STEPS
    action_low, action_high = -np.ones(2), np.ones(2)
    state_size = SEEN
    cost_sources = ("crash",)

    def __init__(self, kind: Kind, batch: int) -> None:
        self.batch = batch
        self.privileged_size = SEEN + GOAL_SIZE[kind]
        self.worlds = [GoalLander(kind) for _ in range(batch)]
        self.told = np.zeros((batch, self.privileged_size), np.float32)
        self.ended = np.ones(batch, bool)

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        chosen = range(self.batch) if rows is None else np.flatnonzero(rows)
        for row, seed in zip(chosen, seeds, strict=True):
            self.told[row], _ = self.worlds[row].reset(seed=seed)
            self.ended[row] = False
        return self._observed()

    def step(self, action: NDArray[Any]) -> Step:
        reward = np.zeros(self.batch)
        reached, crashed, terminated = (np.zeros(self.batch, bool) for _ in range(3))
        going = ~self.ended
        for row in np.flatnonzero(going):
            self.told[row], reward[row], terminated[row], truncated, info = self.worlds[row].step(
                action[row]
            )
            reached[row], crashed[row] = info["reached"], info["crashed"]
            self.ended[row] = terminated[row] or truncated
        counts = crashed.astype(np.int64)
        return Step(
            observation=self._observed(),
            reward=reward,
            cost=crashed,
            cost_env=counts,
            sources={"crash": counts},
            goals=reached.astype(np.int64),
            env_steps=going.astype(np.int64),
            ended=self.ended.copy(),
            terminated=terminated,
        )

    def _observed(self) -> Observation:
        return Observation(None, self.told[:, :SEEN].astype(np.float64), self.told.copy())
