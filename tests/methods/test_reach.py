"""The reachability filter against a safety value whose constraint can be searched on a fine grid."""

from typing import Any

import pytest
import torch
from torch import Tensor

from wasp_cli.methods.base import Heldout
from wasp_cli.methods.configs import ReachConfig
from wasp_cli.methods.reach import ReachabilityFilter
from wasp_cli.models.base import Latent
from wasp_cli.models.reachability import extreme_actions
from wasp_cli.operators.base import EpisodeNoise, Operator
from wasp_cli.tasks.motors import UNKNOWN, Motors

SPREAD = 2048


class Bowl:
    """Q = h - 0.4 |a - (1, -1)|^2 / 8: the safest action is a corner, and V = h."""

    extremes = extreme_actions(2)
    safest = torch.tensor([1.0, -1.0])

    def __call__(self, features: Tensor, actions: Tensor) -> Tensor:
        return features[:, :1] - 0.4 * (actions - self.safest).square().sum(-1) / 8

    def fallback(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return self.safest.expand(len(features), 2), features[:, 0]


def made(gamma: float | str = 0.9, motors: Motors = UNKNOWN, **settings: Any) -> ReachabilityFilter:
    made = object.__new__(ReachabilityFilter)
    made.config = ReachConfig.model_validate({"gamma": gamma, "candidates": SPREAD, **settings})
    made.value, made.motors = Bowl(), motors
    made.gamma = 0.9 if gamma == "calibrated" else float(gamma)
    made.candidates = torch.cat([2 * torch.quasirandom.SobolEngine(2).draw(made.config.candidates) - 1, Bowl.extremes])
    return made


def decide(filter_: ReachabilityFilter, h: Tensor, a_h: Tensor) -> tuple[Tensor, Any]:
    operator = Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * len(h)), len(h))
    decision = filter_.decide(Latent(h.unsqueeze(-1), torch.zeros(len(h), 1)), a_h, operator)
    return decision.action, decision.record


def states(rows: int = 60) -> tuple[Tensor, Tensor]:
    source = torch.Generator().manual_seed(0)
    return 0.2 + 0.8 * torch.rand(rows, generator=source), 2 * torch.rand(rows, 2, generator=source) - 1


def test_the_nearest_action_that_keeps_its_share_of_the_value_is_that_of_a_fine_grid():
    h, a_h = states()
    action, record = decide(made(0.9), h, a_h)
    axis = torch.linspace(-1, 1, 801)
    grid = torch.cartesian_prod(axis, axis)
    moved = 0
    for row in range(len(h)):
        allowed = Bowl()(h[row : row + 1].unsqueeze(-1), grid.unsqueeze(0))[0] >= 0.9 * h[row]
        best = float((grid[allowed] - a_h[row]).norm(dim=-1).min())
        found = float((action[row] - a_h[row]).norm())
        stands = bool(Bowl()(h[row : row + 1].unsqueeze(-1), a_h[row].view(1, 1, 2)) >= 0.9 * h[row])
        assert int(record.gate[row]) == (0 if stands else 3)
        if stands:
            assert torch.equal(action[row], a_h[row])
        else:
            moved += 1
            assert best - 0.01 <= found <= best + 0.04  # 2048 candidates lie about 0.04 apart
            assert bool(Bowl()(h[row : row + 1].unsqueeze(-1), action[row].view(1, 1, 2)) >= 0.9 * h[row] - 1e-6)
    assert 10 < moved < 55


def test_where_failure_cannot_be_avoided_the_fallback_acts():
    action, record = decide(made(0.9), torch.tensor([-0.3, -0.01]), torch.tensor([[0.9, -0.9], [0.0, 0.0]]))
    assert torch.equal(action, Bowl.safest.expand(2, 2))
    assert record.gate.tolist() == [3, 3]


def test_of_all_actions_with_one_force_the_nearest_is_executed():
    """A throttle that saturates at 0.05: to reverse it, a little is enough."""
    filter_ = made(0.95, Motors((0.05, 1.0)))

    class Throttle(Bowl):
        def __call__(self, features: Tensor, actions: Tensor) -> Tensor:
            return features[:, :1] - 0.2 * (1 - (actions[..., 0] / 0.05).clamp(-1, 1))

        def fallback(self, features: Tensor) -> tuple[Tensor, Tensor]:
            return torch.tensor([1.0, 0.0]).expand(len(features), 2), features[:, 0]

    filter_.value = Throttle()
    action, _ = decide(filter_, torch.tensor([0.2]), torch.tensor([[-0.8, 0.3]]))
    assert action[0, 0] == pytest.approx(0.05, abs=0.005)
    assert action[0, 1] == pytest.approx(0.3, abs=0.05)


def test_gamma_is_a_quantile_of_what_the_expert_keeps_where_it_was_harmless():
    rows = 200
    h, a_h = states(rows)
    harmless = torch.arange(rows) % 2 == 0
    ahead = torch.where(harmless, 0.0, 3.0)
    ahead[:10] = torch.nan  # too near to the end of their episode to know
    h[10] = -0.5  # no share of a negative value says anything
    zeros = torch.zeros(rows)
    heldout = Heldout(Latent(h.unsqueeze(-1), torch.zeros(rows, 1)), a_h, zeros, zeros, zeros.long(), zeros)
    operator = Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * rows), rows)
    filter_ = made("calibrated", quantile=0.8)
    found = filter_.calibrate(heldout, ahead, operator, 3)
    q = Bowl()(h.unsqueeze(-1), a_h.unsqueeze(1))[:, 0]
    kept = (q / h)[(ahead == 0) & (h > 0)]
    assert found["gamma"] == pytest.approx(max(0.0, float(torch.quantile(kept, 0.2))), abs=1e-6)
    assert filter_.gamma == found["gamma"]
    assert found["expert_rate"] == pytest.approx(float((q < found["gamma"] * h).float().mean()))
    assert made(0.7).calibrate(heldout, ahead, operator, 3)["gamma"] == 0.7
