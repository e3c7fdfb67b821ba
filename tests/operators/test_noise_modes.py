"""Modes of the noisy operator: Gaussian noise, and bursts of random commands."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.operators.burst import MEAN_BURST, burst_rates

ROWS, STEPS = 40, 500
INTENDED = torch.full((ROWS, 2), 0.25)


def context() -> OperatorContext:
    return OperatorContext(skill=lambda fraction: lambda f: f[:, :2] * fraction, action_size=2, decision_seconds=0.08)


def issued(name: str, value: float) -> Tensor:
    """[STEPS, ROWS, 2] of operators that always intend 0.25."""
    operator = build_operator(name, value, context(), EpisodeNoise(list(range(ROWS))), ROWS)
    return torch.stack([operator.command(INTENDED) for _ in range(STEPS)])


def test_gaussian_noise_has_the_stated_spread_around_the_intended_command():
    error = issued("noisy-gaussian", 0.2) - INTENDED  # the bounds are 3.75 and 6 deviations away
    assert error.mean().abs() < 0.005
    assert error.std().item() == pytest.approx(0.2, rel=0.02)
    inside = (error.abs() < 0.2).float().mean().item()
    assert inside == pytest.approx(0.683, abs=0.01)  # of a normal distribution; a uniform one has 0.577


def test_a_draw_of_zero_gives_a_finite_command():
    operator = build_operator("noisy-gaussian", 0.5, context(), DrawnNoise(torch.zeros(1, 1, 2)), 1)
    assert torch.equal(operator.command(torch.zeros(1, 2)), torch.full((1, 2), -1.0))


def in_burst(name: str, value: float) -> Tensor:
    """[STEPS, ROWS] whether the command was replaced."""
    return (issued(name, value) != INTENDED).any(-1)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_bursts_have_the_stated_share_and_the_stated_length(share):
    on = in_burst("noisy-burst", share)
    assert on.float().mean().item() == pytest.approx(share, abs=0.03)
    ends = (on[:-1] & ~on[1:]).sum().item()
    assert on[:-1].sum().item() / ends == pytest.approx(MEAN_BURST, rel=0.12)


@given(st.floats(0.0, 1.0))
def test_rates_of_bursts_are_probabilities_with_the_stated_stationary_share(share):
    start, stop = burst_rates(share)
    assert 0.0 <= start <= 1.0 + 1e-12
    assert 0.0 <= stop <= 1.0 / MEAN_BURST
    assert start / (start + stop) == pytest.approx(share, abs=1e-9)


def test_an_operator_without_noise_is_the_expert():
    for name in ("noisy", "noisy-gaussian", "noisy-burst", "laggy", "reaction-time"):
        operator: Operator = build_operator(name, 0.0, context(), EpisodeNoise([1, 2]), 2)
        assert torch.equal(operator.command(INTENDED[:2]), INTENDED[:2]), name
