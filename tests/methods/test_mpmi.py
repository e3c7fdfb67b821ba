"""MPMI against a world in which the danger of holding an input is known."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.worlds import Slope, at, calibrated, decided
from wasp_cli.methods.configs import MPMIConfig, ReachConfig
from wasp_cli.methods.mpmi import MPMI
from wasp_cli.methods.noise import DecisionNoise
from wasp_cli.methods.reach import ReachabilityFilter
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.metrics.episode import GATE_METHOD, GATE_NONE
from wasp_cli.models.reachability import extreme_actions
from wasp_cli.tasks.motors import UNKNOWN, Motors

GAMMA, H = 0.9, 4


def expected(h: Tensor, a: Tensor) -> Tensor:
    """Discounted costs [...] of holding inputs [..., A] for H steps from h [...] on."""
    total = torch.zeros_like(h)
    for k in range(H):
        total = total + GAMMA**k * (h + 0.1 * (k + 1) * a[..., 0]).clamp(0, 1)
    return total


def made(shake: float = 0.0, **settings: Any) -> MPMI:
    made = object.__new__(MPMI)
    made.config = MPMIConfig(**{"horizon": H, "rollouts": 2, **settings})
    made.imagination = Imagination(Slope(0.1, shake), None, lambda f: f[:, :2], GAMMA, GAMMA, 0.9)
    made.tau_c = 0.5 if made.config.tau_c == "calibrated" else float(made.config.tau_c)
    made.noise = DecisionNoise()
    made.inputs = 2 * torch.quasirandom.SobolEngine(2).draw(made.config.candidates) - 1
    return made


def situations(rows: int = 40) -> tuple[Tensor, Tensor]:
    source = torch.Generator().manual_seed(1)
    return torch.rand(rows, generator=source), 2 * torch.rand(rows, 2, generator=source) - 1


def test_the_signal_is_the_cost_of_holding_the_command():
    h, a_h = situations()
    torch.testing.assert_close(decided(made(), h, a_h)[1].signal, expected(h, a_h))


def test_the_nearest_safe_input_is_executed_and_a_safe_command_stands():
    h, a_h = situations()
    mpmi = made(tau_c=1.4)
    action, record = decided(mpmi, h, a_h)
    fates = set()
    for row in range(len(h)):
        best, least = a_h[row], float("inf")
        if expected(h[row], a_h[row]) > 1.4:
            for each in mpmi.inputs:
                distance = float((each - a_h[row]).norm())
                if expected(h[row], each) <= 1.4 and distance < least:
                    best, least = each, distance
        assert torch.equal(action[row], best)
        assert record.gate[row] == (GATE_NONE if least == float("inf") else GATE_METHOD)
        fates.add((bool(expected(h[row], a_h[row]) > 1.4), least < float("inf")))
    # safe; replaced; unsafe, and nothing safe
    assert fates == {(False, False), (True, True), (True, False)}


def test_every_input_meets_the_same_draws():
    mpmi = made(shake=0.2, tau_c=1e-6)
    mpmi.reset(torch.ones(1, dtype=torch.bool), [5])
    draws = mpmi._draws(mpmi.noise.streams())
    twice = torch.tensor([[[0.2, -0.3], [0.2, -0.3], [0.2, 0.9]]])
    cost = mpmi.g_c(at(torch.full((1,), 0.5)), twice, draws)
    assert cost[0, 0] == cost[0, 1] == cost[0, 2]  # a_1 moves nothing here
    assert cost[0, 0] != expected(torch.tensor(0.5), twice[0, 0])


def test_the_threshold_is_a_quantile_under_the_expert_where_nothing_cost():
    h, a_h = situations(200)
    ahead = (h > 0.5).float()
    ahead[:3] = torch.nan  # unknown: less than W decisions are left
    mpmi = made(quantile=0.8)
    told = calibrated(mpmi, h, a_h, ahead)
    wanted = torch.quantile(expected(h, a_h)[ahead == 0], 0.8)
    assert told["tau_c"] == mpmi.tau_c == pytest.approx(float(wanted), rel=1e-5)
    assert told["expert_rate"] == pytest.approx(float((expected(h, a_h) > wanted).float().mean()))
    assert calibrated(made(tau_c=0.7), h, a_h, ahead)["tau_c"] == 0.7


# The reachability filter against a safety value whose constraint can be searched on a fine grid.

SPREAD = 2048


class Bowl:
    """Q = h - 0.4 |a - (1, -1)|^2 / 8: the safest action is a corner, and V = h."""

    extremes = extreme_actions(2)
    safest = torch.tensor([1.0, -1.0])

    def __call__(self, features: Tensor, actions: Tensor) -> Tensor:
        return features[:, :1] - 0.4 * (actions - self.safest).square().sum(-1) / 8

    def fallback(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return self.safest.expand(len(features), 2), features[:, 0]


def made_reach(
    gamma: float | str = 0.9, motors: Motors = UNKNOWN, **settings: Any
) -> ReachabilityFilter:
    made_reach = object.__new__(ReachabilityFilter)
    made_reach.config = ReachConfig.model_validate(
        {"gamma": gamma, "candidates": SPREAD, **settings}
    )
    made_reach.value, made_reach.motors = Bowl(), motors
    made_reach.gamma = 0.9 if gamma == "calibrated" else float(gamma)
    made_reach.candidates = torch.cat(
        [2 * torch.quasirandom.SobolEngine(2).draw(made_reach.config.candidates) - 1, Bowl.extremes]
    )
    return made_reach


def states(rows: int = 60) -> tuple[Tensor, Tensor]:
    source = torch.Generator().manual_seed(0)
    return 0.2 + 0.8 * torch.rand(rows, generator=source), 2 * torch.rand(
        rows, 2, generator=source
    ) - 1


def test_the_nearest_action_that_keeps_its_share_of_the_value_is_that_of_a_fine_grid():
    h, a_h = states()
    action, record = decided(made_reach(0.9), h, a_h)
    axis = torch.linspace(-1, 1, 401)
    grid = torch.cartesian_prod(axis, axis)
    moved = 0
    for row in range(len(h)):
        allowed = Bowl()(h[row : row + 1].unsqueeze(-1), grid.unsqueeze(0))[0] >= 0.9 * h[row]
        best = float((grid[allowed] - a_h[row]).norm(dim=-1).min())
        found = float((action[row] - a_h[row]).norm())
        stands = bool(
            Bowl()(h[row : row + 1].unsqueeze(-1), a_h[row].view(1, 1, 2)) >= 0.9 * h[row]
        )
        assert int(record.gate[row]) == (0 if stands else 3)
        if stands:
            assert torch.equal(action[row], a_h[row])
        else:
            moved += 1
            assert best - 0.01 <= found <= best + 0.04  # 2048 candidates lie about 0.04 apart
            assert bool(
                Bowl()(h[row : row + 1].unsqueeze(-1), action[row].view(1, 1, 2))
                >= 0.9 * h[row] - 1e-6
            )
    assert 10 < moved < 55


def test_where_failure_cannot_be_avoided_the_fallback_acts():
    action, record = decided(
        made_reach(0.9), torch.tensor([-0.3, -0.01]), torch.tensor([[0.9, -0.9], [0.0, 0.0]])
    )
    assert torch.equal(action, Bowl.safest.expand(2, 2))
    assert record.gate.tolist() == [3, 3]


def test_of_all_actions_with_one_force_the_nearest_is_executed():
    """A throttle that saturates at 0.05: to reverse it, a little is enough."""
    filter_ = made_reach(0.95, Motors((0.05, 1.0)))

    class Throttle(Bowl):
        def __call__(self, features: Tensor, actions: Tensor) -> Tensor:
            return features[:, :1] - 0.2 * (1 - (actions[..., 0] / 0.05).clamp(-1, 1))

        def fallback(self, features: Tensor) -> tuple[Tensor, Tensor]:
            return torch.tensor([1.0, 0.0]).expand(len(features), 2), features[:, 0]

    filter_.value = Throttle()
    action, _ = decided(filter_, torch.tensor([0.2]), torch.tensor([[-0.8, 0.3]]))
    assert action[0, 0] == pytest.approx(0.05, abs=0.005)
    assert action[0, 1] == pytest.approx(0.3, abs=0.05)


def test_gamma_is_a_quantile_of_what_the_expert_keeps_where_it_was_harmless():
    rows = 200
    h, a_h = states(rows)
    harmless = torch.arange(rows) % 2 == 0
    ahead = torch.where(harmless, 0.0, 3.0)
    ahead[:10] = torch.nan  # too near to the end of their episode to know
    h[10] = -0.5  # no share of a negative value says anything
    filter_ = made_reach("calibrated", quantile=0.8)
    found = calibrated(filter_, h, a_h, ahead)
    q = Bowl()(h.unsqueeze(-1), a_h.unsqueeze(1))[:, 0]
    kept = (q / h)[(ahead == 0) & (h > 0)]
    assert found["gamma"] == pytest.approx(max(0.0, float(torch.quantile(kept, 0.2))), abs=1e-6)
    assert filter_.gamma == found["gamma"]
    assert found["expert_rate"] == pytest.approx(float((q < found["gamma"] * h).float().mean()))
    assert calibrated(made_reach(0.7), h, a_h, ahead)["gamma"] == 0.7
