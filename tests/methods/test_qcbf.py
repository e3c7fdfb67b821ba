"""The Q-CBF filter in a double integrator, whose safety value is known in closed form."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.worlds import anybody
from wasp_cli.methods.base import Decision, Heldout
from wasp_cli.methods.configs import QCBFConfig
from wasp_cli.methods.qcbf import QCBFFilter
from wasp_cli.models.base import Latent
from wasp_cli.tasks.motors import UNKNOWN, Motors

PUSH = 0.1  # what a full action changes of a speed
NORMAL = torch.tensor([0.8, 0.6])  # of the wall that must not be passed
ROWS = 80


class Wall:
    """Two double integrators: v' = v + PUSH a, x' = x + v', and a wall at NORMAL x = 1.

    Q is the distance that is left to the wall when the action is followed by full braking. The
    push of an action grows up to `limit`.
    """

    def __init__(self, limit: float = 1.0) -> None:
        self.limit = limit

    def __call__(self, features: Tensor, actions: Tensor) -> Tensor:
        actions = (actions / self.limit).clamp(-1, 1)
        speed = (features[:, 2:].unsqueeze(1) + PUSH * actions) @ NORMAL
        place = (features[:, :2] @ NORMAL).unsqueeze(1) + speed
        return 1 - place - speed.clamp(min=0).square() / (2 * PUSH * float(NORMAL.sum()))


def brake(features: Tensor) -> Tensor:
    return -torch.ones(len(features), 2)


def made(gamma: float | str = 0.9, motors: Motors = UNKNOWN, **settings: Any) -> QCBFFilter:
    made = object.__new__(QCBFFilter)
    made.config = QCBFConfig.model_validate({"gamma": gamma, **settings})
    made.value, made.actor, made.motors = Wall(), brake, motors
    made.gamma = 0.7 if gamma == "calibrated" else float(gamma)
    return made


def situations(rows: int = ROWS) -> tuple[Tensor, Tensor]:
    """Features [rows, 4] before the wall, from which braking is in time, and commands."""
    source = torch.Generator().manual_seed(0)
    place = torch.rand(rows, 2, generator=source) - 0.6
    speed = 0.3 * torch.rand(rows, 2, generator=source) - 0.1
    return torch.cat([place, speed], -1), 2 * torch.rand(rows, 2, generator=source) - 1


def decided(filter_: QCBFFilter, features: Tensor, a_h: Tensor) -> Decision:
    filter_.reset(torch.ones(len(a_h), dtype=torch.bool), list(range(len(a_h))))
    with torch.inference_mode():
        latent = Latent(features[:, :2], features[:, 2:])
        return filter_.decide(latent, a_h, anybody(len(a_h)))


def of(features: Tensor, action: Tensor) -> Tensor:
    return Wall()(features, action.unsqueeze(1)).squeeze(1)


def test_a_command_that_keeps_its_share_of_the_value_stands_bit_for_bit():
    features, a_h = situations()
    decision = decided(made(0.9), features, a_h)
    meets = of(features, a_h) >= 0.9 * of(features, brake(features))
    assert 10 < int(meets.sum()) < ROWS - 10
    assert torch.equal(decision.action[meets], a_h[meets])
    assert torch.equal(decision.record.gate == 0, meets)


@pytest.mark.parametrize("settings", [{}, {"steps": 0}, {"steps": 3, "segment": 4}])
def test_no_action_breaks_the_condition_where_one_meets_it(settings):
    features, a_h = situations()
    value = of(features, brake(features))
    assert (value > 0).all()
    action = decided(made(0.9, **settings), features, a_h).action
    assert (of(features, action) >= 0.9 * value - 1e-6).all()


def test_the_action_is_the_nearest_of_a_dense_grid():
    features, a_h = situations()
    decision = decided(made(0.9), features, a_h)
    axis = torch.linspace(-1, 1, 401)
    grid = torch.cartesian_prod(axis, axis)
    value = of(features, brake(features))
    allowed = Wall()(features, grid.unsqueeze(0)) >= 0.9 * value.unsqueeze(1)  # [B, G]
    distance = (grid.unsqueeze(0) - a_h.unsqueeze(1)).norm(dim=-1).masked_fill(~allowed, torch.inf)
    best = distance.amin(1)
    moved = decision.record.gate != 0
    found = (decision.action - a_h).norm(dim=-1)
    assert int(moved.sum()) > 10
    assert (found >= best - 0.01)[moved].all()
    # At a bound of the actions the steps slide along it, which is not quite the shortest way.
    gap = (found - best)[moved]
    assert gap.max() < 0.15
    assert gap.median() < 0.005


def test_the_line_to_the_fallback_alone_finds_actions_that_are_further_away():
    features, a_h = situations()
    both, line = (decided(made(0.9, **some), features, a_h) for some in ({}, {"steps": 0}))
    far, near = ((each.action - a_h).norm(dim=-1) for each in (line, both))
    assert (near <= far + 1e-3).all()
    assert (near < far - 0.05).any()


def test_where_failure_cannot_be_avoided_the_fallback_acts():
    features = torch.tensor([[0.9, 0.9, 0.3, 0.3]]).expand(3, 4)
    a_h = torch.tensor([[0.9, -0.9], [0.0, 0.0], [-0.5, -0.5]])
    assert (of(features, brake(features)) < 0).all()
    decision = decided(made(0.9), features, a_h)
    assert torch.equal(decision.action, brake(features))
    assert (decision.record.gate == 3).all()


def test_of_all_actions_with_one_force_the_nearest_is_executed():
    limit = 0.05
    motors = Motors((limit, limit))
    features, a_h = situations()
    filter_ = made(0.9, motors)
    filter_.value = Wall(limit)
    action = decided(filter_, features, a_h).action
    value = Wall(limit)(features, brake(features).unsqueeze(1)).squeeze(1)
    kept = Wall(limit)(features, action.unsqueeze(1)).squeeze(1)
    assert (kept >= 0.9 * value - 1e-6).all()
    assert torch.equal(action, motors.least(a_h, action))
    assert (action != a_h).any()


def test_gamma_is_a_quantile_of_what_the_expert_keeps_where_it_was_harmless():
    features, a_h = situations(200)
    ahead = torch.where(torch.arange(200) % 2 == 0, 0.0, 3.0)
    ahead[:10] = torch.nan  # too near to the end of their episode to know
    zeros = torch.zeros(200)
    heldout = Heldout(
        Latent(features[:, :2], features[:, 2:]), a_h, zeros, zeros, zeros.long(), zeros
    )
    kept = of(features, a_h) / of(features, brake(features))
    wanted = torch.quantile(kept[ahead == 0], 0.2).clamp(0, 1)

    filter_ = made("calibrated", quantile=0.8)
    found = filter_.calibrate(heldout, ahead, anybody(200), 3)
    assert found["gamma"] == filter_.gamma == pytest.approx(float(wanted), abs=1e-6)
    assert found["expert_rate"] == pytest.approx(float((kept < wanted).float().mean()))
    assert made(0.6).calibrate(heldout, ahead, anybody(200), 3)["gamma"] == 0.6
