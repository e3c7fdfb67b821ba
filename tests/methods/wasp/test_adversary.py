"""The adversary of imagined rollouts: what bounds it, and what it does to costs."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.artifacts import SIZES, tiny_latents
from wasp_cli.learning.adversary import conformal, per_episode
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.methods.base import Parts
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.record import Record
from wasp_cli.models.adversary import (
    Adversary,
    DisturbedModel,
    divergence,
    likely,
    within,
)
from wasp_cli.models.weights import load_module
from wasp_cli.operators.base import EpisodeNoise, Operator

ROWS = 200
SMALL: dict[str, Any] = {
    "candidates": 12,
    "elites": 4,
    "feasible": 4,
    "iterations": 2,
    "rollouts": 2,
    "horizon": 6,
    "tau_c": 1.2,
}


@pytest.fixture
def parts(artifacts) -> Parts:
    return load_parts(artifacts, ReturnsConfig())


@pytest.fixture
def adversary(parts) -> Adversary:
    return load_module(Adversary, parts.inputs["adversary"] / "adversary.safetensors")


def priors(seed: int = 0) -> Tensor:
    """Log-probabilities [ROWS, S, C]."""
    logits = torch.randn(ROWS, 3, 5, generator=torch.Generator().manual_seed(seed))
    return (2 * logits).log_softmax(-1)


def gumbel(*shape: int, seed: int = 7) -> Tensor:
    uniform = torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    return -(-uniform.clamp(1e-9, 1 - 1e-6).log()).log()


def test_a_disturbed_distribution_stays_within_the_budget_and_uses_it():
    prior, tilt = priors(), 15 * torch.tanh(priors(1))
    for radius in (0.01, 0.1, 0.5):
        found = within(prior, tilt, torch.tensor(radius))
        torch.testing.assert_close(found.exp().sum(-1), torch.ones(ROWS, 3))
        spent = divergence(found, prior)
        assert (spent <= radius + 1e-5).all()
        assert float(spent.median()) > 0.9 * radius
    far = within(prior, tilt, torch.tensor(1e3))
    torch.testing.assert_close(far, (prior + tilt).log_softmax(-1))


def test_without_a_budget_the_distribution_comes_back_bit_for_bit():
    prior, tilt = priors(), 15 * torch.tanh(priors(1))
    assert torch.equal(within(prior, tilt, torch.tensor(0.0)), prior)
    torch.testing.assert_close(within(prior, torch.zeros_like(tilt), torch.tensor(0.5)), prior)


def test_on_common_draws_a_larger_budget_never_draws_a_class_that_costs_less():
    prior, noise = priors(), gumbel(ROWS, 3, 5)
    cost = torch.rand(ROWS, 3, 5, generator=torch.Generator().manual_seed(3))
    drawn = []
    for radius in (0.0, 0.05, 0.2, 0.8):
        found = within(prior, 8 * cost, torch.tensor(radius))
        index = (found + noise).argmax(-1, keepdim=True)
        drawn.append(cost.gather(-1, index).squeeze(-1))
    # One share for all the variables of a row: each variable is monotone in it.
    for less, more in pairwise(drawn):
        assert (more >= less).all()
        assert more.mean() > less.mean()


def test_the_likely_classes_are_the_smallest_set_of_that_probability():
    probs = torch.tensor([[0.5, 0.3, 0.15, 0.05], [0.05, 0.92, 0.02, 0.01]])
    assert likely(probs.log(), 0.9).tolist() == [
        [True, True, True, False],
        [False, True, False, False],
    ]


def test_classes_that_the_model_finds_unlikely_are_not_promoted(adversary, parts):
    latent = tiny_latents(ROWS, 0)
    prior = parts.world_model.rssm.prior(latent.h)
    found = adversary.disturbed(latent.h, prior)
    unlikely = ~likely(prior, adversary.mass)
    assert unlikely.any()
    gained = (found - prior).detach()
    most = gained.amax(-1, keepdim=True).expand_as(gained)
    assert (gained[unlikely] <= 1e-5).all()
    assert (most > 1e-3).any()


def test_without_a_budget_imagined_steps_are_those_of_the_model(adversary, parts):
    latent, noise = tiny_latents(ROWS, 0), gumbel(ROWS, SIZES.variables * SIZES.classes)
    action = 2 * torch.rand(ROWS, 2, generator=torch.Generator().manual_seed(1)) - 1
    model = parts.world_model
    same = DisturbedModel(model, adversary, 0.0).imagine(latent, action, noise)
    own = model.imagine(latent, action, noise)
    assert torch.equal(same.h, own.h)
    assert torch.equal(same.z, own.z)
    other = DisturbedModel(model, adversary, 1.0).imagine(latent, action, noise)
    assert torch.equal(other.h, own.h)
    assert not torch.equal(other.z, own.z)


def test_a_disturbed_latent_that_looks_like_none_of_the_data_is_dropped(adversary, parts):
    latent, noise = tiny_latents(ROWS, 0), gumbel(ROWS, SIZES.variables * SIZES.classes)
    action = torch.zeros(ROWS, 2)
    model = parts.world_model
    own = model.imagine(latent, action, noise)
    free = DisturbedModel(model, adversary).imagine(latent, action, noise)
    adversary.threshold.fill_(float(adversary.oddness(free).median()))
    bound = DisturbedModel(model, adversary).imagine(latent, action, noise)
    odd = adversary.oddness(free) > adversary.threshold
    assert torch.equal(bound.z[odd], own.z[odd])
    assert torch.equal(bound.z[~odd], free.z[~odd])
    assert (free.z != own.z)[odd].any()


def test_oddness_is_about_one_on_average_over_the_data_and_larger_elsewhere(adversary):
    data = tiny_latents(2000, 0)
    adversary.learn_data(data.features)
    assert float(adversary.oddness(data).mean()) == pytest.approx(1.0, abs=0.2)
    strange = data._replace(h=data.h + 5)
    assert (adversary.oddness(strange) > adversary.oddness(data)).float().mean() > 0.99


def looked_at(parts: Parts, **settings: Any) -> Record:
    latent = tiny_latents(ROWS, 0)
    a_h = 2 * torch.rand(ROWS, 2, generator=torch.Generator().manual_seed(0)) - 1
    assistant = build_assistant("wasp", SMALL | settings, parts)
    assistant.reset(torch.ones(ROWS, dtype=torch.bool), list(range(ROWS)))
    operator = Operator(parts.skills.expert, 2, EpisodeNoise([0] * ROWS), ROWS)
    with torch.inference_mode():
        decision = assistant.decide(latent, a_h, operator)
    assert decision.record is not None
    return decision.record


def test_a_gate_with_the_adversary_never_reads_a_lower_cost(parts):
    alone = looked_at(parts)
    opposed = looked_at(parts, adversary="lucid")
    assert (opposed.g_cost >= alone.g_cost).all()
    assert (opposed.g_cost > alone.g_cost).any()
    assert torch.equal(opposed.g_return, alone.g_return)
    nothing = looked_at(parts, adversary="lucid", adversary_budget=0.0)
    torch.testing.assert_close(nothing.g_cost, alone.g_cost, atol=1e-5, rtol=1e-5)


def test_the_default_has_no_adversary_and_the_identity_of_before():
    assert WASPConfig().identity() == {}
    assert WASPConfig(adversary="lucid").identity() == {"adversary": "lucid"}


def test_a_conformal_threshold_covers_at_least_the_promised_share():
    source = torch.Generator().manual_seed(0)
    for count, alpha in ((19, 0.1), (50, 0.05)):
        covered = []
        for _ in range(400):
            scores = torch.rand(count + 1, generator=source).square()
            covered.append(float(scores[-1]) <= conformal(scores[:-1], alpha))
        share = sum(covered) / len(covered)
        assert share >= 1 - alpha - 3 * math.sqrt(alpha * (1 - alpha) / len(covered))
    # Too few for one in a hundred: the largest is the best that there is.
    assert conformal(torch.tensor([0.3, 0.9, 0.5]), 0.01) == pytest.approx(0.9)


def test_a_trajectory_counts_by_its_largest_score():
    score = torch.tensor([0.1, 0.7, 0.2, 0.4, 0.3])
    episode = torch.tensor([4, 4, 9, 9, 9])
    assert per_episode(score, episode).tolist() == pytest.approx([0.7, 0.4])
