"""Worlds without a world model: the loop, Diffusion and IDA run where the state is the latent and only the operator sees the goal."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from wasp_cli.learning.closed_loop import Loop, run_episodes
from wasp_cli.learning.configs.baselines import DenoiserConfig
from wasp_cli.learning.denoiser import train_denoiser
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.shards import Recording
from wasp_cli.methods.base import Assistant, Parts
from wasp_cli.methods.configs import DiffusionConfig, IDAConfig
from wasp_cli.methods.diffusion import Diffusion
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.ida import IDA
from wasp_cli.models.ensemble import QEnsemble
from wasp_cli.models.policy import Skills
from wasp_cli.models.state import StateWorld
from wasp_cli.models.weights import save_weights
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext
from wasp_cli.stages.base import no_progress
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


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> Parts:
    """A denoiser of commands that are always 1, and critics of which three of four like larger commands."""
    folder: Path = tmp_path_factory.mktemp("parts")
    config = DenoiserConfig(steps=20, hidden=(32,), updates=400, batch=64)
    state = torch.linspace(-1, 1, 200)[:, None]
    recording = Recording(**dict.fromkeys(Recording._fields, np.zeros(0)) | {"episode": np.arange(200) // 20})
    latents = Latents(state, torch.zeros(200, 0, dtype=torch.uint8), 1)
    torch.manual_seed(0)
    denoiser, schedule, _ = train_denoiser(recording, torch.ones(200, 1), latents, config, 0, no_progress)
    levels = {"steps": schedule.steps, "beta_min": config.beta_min, "beta_max": config.beta_max}
    save_weights(denoiser, folder / "denoiser.safetensors", features=1, action=1, hidden=[32], steps=schedule.steps, schedule=levels)
    critics = QEnsemble(4, 1, 1, [])
    with torch.no_grad():
        critics.weights[0].copy_(torch.tensor([[0.0, 1.0], [0.0, 2.0], [0.0, 1.0], [0.0, -1.0]]).unsqueeze(-1))
    save_weights(critics, folder / "ensemble.safetensors", members=4, features=1, action=1, hidden=[])
    inputs = {"denoiser": folder, "ida_q": folder}
    return Parts(WORLD, Skills((1.0,), 1, (1,), 1), inputs, {}, gamma_r=0.99, gamma_c=0.99, lam=0.95)


def test_an_informed_pilot_flies_to_a_goal_that_the_latent_does_not_have():
    loop = flown(HumanOnly())
    assert loop.goals.sum(0).tolist() == [1] * ROWS
    assert loop.h.shape == (len(loop.reward), ROWS, 1)
    assert loop.z.shape[-1] == 0
    assert (np.sign(loop.a_h[0, :, 0]) == [-1, 1, -1, 1, -1, 1]).all()


def test_diffusion_knows_what_was_demonstrated_and_keeps_commands_at_zero(parts):
    kept, changed = (flown(Diffusion(DiffusionConfig(ratio=ratio), parts)) for ratio in (0.0, 1.0))
    assert (kept.action == kept.a_h).all()
    assert changed.action[0].mean() > 0.5, "all was demonstrated to go one way"


def test_ida_takes_over_where_all_of_its_critics_agree(parts):
    for vote, intervenes in ((0.99, False), (0.4, True)):
        loop = flown(IDA(IDAConfig(copilot="diffusion", ratio=1.0, vote=vote), parts))
        towards_one = loop.a_h[0, :, 0] < 0
        assert (loop.action[0, towards_one] != loop.a_h[0, towards_one]).any() == intervenes
