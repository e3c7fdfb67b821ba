"""MPMI against a world in which the danger of holding an input is known."""

from typing import Any

import pytest
import torch
from torch import Tensor

from wasp_cli.methods.base import Heldout
from wasp_cli.methods.configs import MPMIConfig
from wasp_cli.methods.mpmi import MPMI
from wasp_cli.methods.noise import DecisionNoise
from wasp_cli.methods.record import Record
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.metrics.episode import GATE_METHOD, GATE_NONE
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator

GAMMA, H = 0.9, 4


class Slope:
    """A step adds 0.1 a_0 to h, and costs with probability h (within [0, 1]); noise moves h by nothing or, when asked, by a little."""

    action_size, noise_size = 2, 3

    def __init__(self, shake: float = 0.0) -> None:
        self.shake = shake

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        return Latent(latent.h + 0.1 * action[:, :1] + self.shake * noise[:, :1], latent.z)

    def cost(self, latent: Latent) -> Tensor:
        return latent.h[..., 0].clamp(0, 1)

    def continues(self, latent: Latent) -> Tensor:
        return torch.ones_like(latent.h[..., 0])


def expected(h: Tensor, a: Tensor) -> Tensor:
    """Discounted costs [...] of holding inputs [..., A] for H steps from h [...] on."""
    total = torch.zeros_like(h)
    for k in range(H):
        total = total + GAMMA**k * (h + 0.1 * (k + 1) * a[..., 0]).clamp(0, 1)
    return total


def made(shake: float = 0.0, **settings: Any) -> MPMI:
    made = object.__new__(MPMI)
    made.config = MPMIConfig(**{"horizon": H, "rollouts": 2, **settings})
    made.imagination = Imagination(Slope(shake), None, lambda f: f[:, :2], GAMMA, GAMMA, 0.9)
    made.tau_c = 0.5 if made.config.tau_c == "calibrated" else float(made.config.tau_c)
    made.noise = DecisionNoise()
    made.inputs = 2 * torch.quasirandom.SobolEngine(2).draw(made.config.candidates) - 1
    return made


def decide(mpmi: MPMI, h: Tensor, a_h: Tensor) -> tuple[Tensor, Record]:
    rows = len(h)
    mpmi.reset(torch.ones(rows, dtype=torch.bool), list(range(rows)))
    operator = Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * rows), rows)
    decision = mpmi.decide(Latent(h.unsqueeze(-1), torch.zeros(rows, 1)), a_h, operator)
    assert decision.record is not None
    return decision.action, decision.record


def situations(rows: int = 40) -> tuple[Tensor, Tensor]:
    source = torch.Generator().manual_seed(1)
    return torch.rand(rows, generator=source), 2 * torch.rand(rows, 2, generator=source) - 1


def test_the_signal_is_the_cost_of_holding_the_command():
    h, a_h = situations()
    torch.testing.assert_close(decide(made(), h, a_h)[1].signal, expected(h, a_h))


def test_the_nearest_safe_input_is_executed_and_a_safe_command_stands():
    h, a_h = situations()
    mpmi = made(tau_c=1.4)
    action, record = decide(mpmi, h, a_h)
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
    assert fates == {(False, False), (True, True), (True, False)}  # safe; replaced; unsafe, and nothing safe


def test_every_input_meets_the_same_draws():
    mpmi = made(shake=0.2, tau_c=1e-6)
    mpmi.reset(torch.ones(1, dtype=torch.bool), [5])
    draws = mpmi._draws(mpmi.noise.streams())
    twice = torch.tensor([[[0.2, -0.3], [0.2, -0.3], [0.2, 0.9]]])
    cost = mpmi.g_c(Latent(torch.full((1, 1), 0.5), torch.zeros(1, 1)), twice, draws)
    assert cost[0, 0] == cost[0, 1] == cost[0, 2]  # a_1 moves nothing here
    assert cost[0, 0] != expected(torch.tensor(0.5), twice[0, 0])


def test_the_threshold_is_a_quantile_under_the_expert_where_nothing_cost():
    h, a_h = situations(200)
    latent, nothing = Latent(h.unsqueeze(-1), torch.zeros(200, 1)), torch.zeros(200)
    ahead = (h > 0.5).float()
    ahead[:3] = torch.nan  # unknown: less than W decisions are left
    heldout = Heldout(latent, a_h, nothing, nothing, nothing, nothing)
    mpmi = made(quantile=0.8)
    told = mpmi.calibrate(heldout, ahead, Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * 200), 200), 3)
    wanted = torch.quantile(expected(h, a_h)[ahead == 0], 0.8)
    assert told["tau_c"] == mpmi.tau_c == pytest.approx(float(wanted), rel=1e-5)
    assert told["expert_rate"] == pytest.approx(float((expected(h, a_h) > wanted).float().mean()))
    fixed = made(tau_c=0.7)
    assert fixed.calibrate(heldout, ahead, Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * 200), 200), 3)["tau_c"] == 0.7
