"""The safety filter against a world in which the danger of an action is known."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests.worlds import Slope, calibrated, decided
from wasp_cli.methods.configs import FilterConfig
from wasp_cli.methods.filter import SafetyFilter
from wasp_cli.methods.noise import DecisionNoise

GAMMA = 0.9


def made(value: float = 0.0, **settings: Any) -> SafetyFilter:
    """A filter on a slope, with V_c the same everywhere."""
    made = object.__new__(SafetyFilter)
    made.config = FilterConfig(**settings)
    made.model, made.gamma_c = Slope(0.4), GAMMA
    made.critics = SimpleNamespace(value_c=lambda latent: torch.full((len(latent.h),), value))
    made.tau_c = 0.5 if made.config.tau_c == "calibrated" else float(made.config.tau_c)
    made.noise = DecisionNoise()
    return made


def test_the_signal_is_the_cost_of_the_next_step_and_what_the_critic_expects_behind_it():
    _, record = decided(made(value=2.0), torch.tensor([0.3]), torch.tensor([[0.5, 0.0]]))
    assert record.signal.item() == pytest.approx(0.3 + 0.4 * 0.5 + GAMMA * 2.0)


def test_an_unsafe_command_is_moved_no_further_than_the_threshold_asks_for():
    h, a_h = torch.tensor([0.5, 0.3, 0.6]), torch.tensor([[1.0, 0.3], [0.9, -0.2], [0.5, 0.0]])
    action, record = decided(made(tau_c=0.6, segment=400), h, a_h)
    assert record.gate.tolist() == [3, 3, 3]
    # Brute force along the same line: all safest actions have a_0 = -1.
    wanted = (0.6 - h) / 0.4
    assert torch.all(action[:, 0] <= wanted + 1e-6)
    torch.testing.assert_close(action[:, 0], wanted, atol=2.5 * 2 / 400, rtol=0)
    # It stays on the segment to a corner: as far towards it in every component.
    share = (a_h[:, 0] - action[:, 0]) / (a_h[:, 0] + 1)
    corner = (action[:, 1] - (1 - share) * a_h[:, 1]) / share
    assert torch.all(corner.abs() <= 1 + 1e-4)


def test_where_no_action_is_safe_the_safest_is_executed():
    action, _ = decided(made(tau_c=0.1), torch.tensor([0.9]), torch.tensor([[1.0, 0.0]]))
    assert action[0, 0] == -1


def test_many_actions_have_too_many_corners_to_try_them_all():
    a_h = torch.full((2, 24), 0.9)  # 2^24 corners
    action, _ = decided(made(tau_c=0.6, candidates=32, segment=8), torch.tensor([0.5, 0.1]), a_h)
    assert action[0, 0] < 0.9
    assert torch.equal(action[1], a_h[1])


def test_the_threshold_is_a_quantile_over_what_was_harmless():
    rows = 200
    h = torch.linspace(0, 0.8, rows)
    harmless = torch.arange(rows) % 2 == 0
    ahead = torch.where(harmless, 0.0, 3.0)
    ahead[:10] = torch.nan  # too near to the end of their episode to know
    filter_ = made(quantile=0.8)
    found = calibrated(filter_, h, torch.zeros(rows, 2), ahead)
    kept = h[(ahead == 0)]
    assert found["tau_c"] == pytest.approx(float(torch.quantile(kept, 0.8)), abs=1e-6)
    assert filter_.tau_c == found["tau_c"]
    assert found["expert_rate"] == pytest.approx(float((h > found["tau_c"]).float().mean()))
    assert calibrated(made(tau_c=0.7), h, torch.zeros(rows, 2), ahead)["tau_c"] == 0.7
