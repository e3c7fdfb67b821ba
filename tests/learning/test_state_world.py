"""Worlds without a world model: the loop, Diffusion and IDA run where the state is the latent and only the operator sees the goal."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.closed_loop import Loop, run_episodes
from wasp_cli.methods.base import Assistant
from wasp_cli.methods.human import HumanOnly
from wasp_cli.models.state import StateWorld
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext
from wasp_cli.tasks.base import Bools, Observation, Step

ROWS = 6
WORLD = StateWorld(1, 1)


class Line:
    """A place on a line, moved by a tenth of the command; the goal, at 1 or -1, is privileged."""

    action_size = action_repeat = state_size = 1
    privileged_size = 2
    decision_seconds, max_decisions, cost_sources = 1.0, 20, ()
    action_low, action_high = -np.ones(1), np.ones(1)

    def __init__(self, batch: int) -> None:
        self.batch = batch

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        self.goal = np.array([1.0 if seed % 2 else -1.0 for seed in seeds])
        self.place, self.ended = np.zeros(self.batch), np.zeros(self.batch, bool)
        return self._observed()

    def step(self, action: NDArray[Any]) -> Step:
        going = ~self.ended
        self.place = self.place + 0.1 * action[:, 0] * going
        reached = going & (np.abs(self.place - self.goal) < 0.05)
        self.ended = self.ended | reached
        none, count = np.zeros(self.batch, np.int64), going.astype(np.int64)
        return Step(
            self._observed(), np.zeros(self.batch), none.astype(bool), none, {}, reached.astype(np.int64), count, self.ended.copy(), reached
        )

    def _observed(self) -> Observation:
        known = np.stack([self.place, self.goal], 1).astype(np.float32)
        return Observation(None, self.place[:, None].copy(), known)


def pilot() -> Operator:
    """Knows the goal; its `policy` would do nothing."""
    towards = OperatorContext(lambda _: torch.zeros_like, 1, 1.0, informed=lambda _: lambda known: known[:, 1:])
    return Operator.build(1.0, towards, EpisodeNoise(range(ROWS)), ROWS)


def flown(assistant: Assistant) -> Loop:
    seeds = range(ROWS)
    return run_episodes(Line(ROWS), WORLD, pilot(), assistant, seeds, seeds, keep_latents=True)


def test_an_informed_pilot_flies_to_a_goal_that_the_latent_does_not_have():
    loop = flown(HumanOnly())
    assert loop.goals.sum(0).tolist() == [1] * ROWS
    assert loop.h.shape == (len(loop.reward), ROWS, 1)
    assert loop.z.shape[-1] == 0
    assert (np.sign(loop.a_h[0, :, 0]) == [-1, 1, -1, 1, -1, 1]).all()
