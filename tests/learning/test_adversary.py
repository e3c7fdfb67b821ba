"""How the adversary's budget is calibrated, and that it learns to use it."""

from __future__ import annotations

import pytest
import torch

from tests.artifacts import SIZES, tiny_latents
from tests.learning.recordings import recording
from wasp_cli.learning.adversary import (
    calibrate,
    conformal,
    effect,
    per_episode,
    surprise,
    train_adversary,
)
from wasp_cli.learning.configs.adversary import AdversaryConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.shards import Recording
from wasp_cli.models.adversary import Adversary
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.stages.base import no_progress

GAMMA_C = 0.95


@pytest.fixture
def model() -> SafetyWorldModel:
    torch.manual_seed(0)
    made = SafetyWorldModel(SIZES).requires_grad_(False).eval()
    torch.nn.init.normal_(made.cost_head[-1].weight, std=2.0)
    return made


def untrained() -> Adversary:
    torch.manual_seed(1)
    return Adversary(SIZES.deter, SIZES.variables, SIZES.classes, [16])


def recorded(lengths: tuple[int, ...]) -> tuple[Recording, Latents]:
    told = recording(lengths)
    latent = tiny_latents(len(told.first), 3)
    classes = latent.z.unflatten(-1, (SIZES.variables, SIZES.classes)).argmax(-1)
    return told, Latents(latent.h, classes.to(torch.uint8), SIZES.classes)


def test_the_budget_covers_the_promised_share_of_the_trajectories(model):
    told, latents = recorded((5,) * 20)
    adversary = untrained()
    found = calibrate(adversary, model, latents, told, alpha=0.2)
    inside = torch.from_numpy(told.first == 0)
    episode = torch.from_numpy(told.episode)
    maxima = per_episode(surprise(model, latents, told)[inside], episode[inside])
    assert found["radius"] == pytest.approx(conformal(maxima, 0.2))
    assert found["trajectories"] == 20
    assert 0.8 <= found["covered"] < 1
    assert found["covered"] == pytest.approx(float((maxima <= found["radius"]).float().mean()))
    odd = per_episode(adversary.oddness(latents.at(torch.arange(len(episode)))), episode)
    assert float((odd <= adversary.threshold).float().mean()) >= 0.8


def test_what_it_learns_raises_the_imagined_cost_and_more_with_more_of_the_budget(model):
    told, latents = recorded((12, 9, 15))
    skills = Skills([1.0], model.feature_size, [8], 2)
    adversary = untrained()
    adversary.radius.fill_(0.3)
    config = AdversaryConfig(updates=40, batch=32, horizon=5, learning_rate=1e-2)
    curve = train_adversary(
        adversary, model, skills, told, latents, config, GAMMA_C, 1, no_progress
    )
    assert curve[-1]["cost"] > curve[0]["cost"]
    start = tiny_latents(300, 9)
    command = 2 * torch.rand(300, 2, generator=torch.Generator().manual_seed(2)) - 1
    found = effect(adversary, model, skills, start, command, 5, GAMMA_C, 4)
    costs = [found[f"cost_at_{share:g}"] for share in (0.0, 0.25, 0.5, 1.0)]
    assert costs == sorted(costs)
    assert costs[-1] > 1.1 * costs[0]
