"""Imagined rollouts against plain loops: composition, the operator's memory, common draws."""

import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.wasp.imagine import (
    Compose,
    Draws,
    Imagination,
    Situation,
    corrected,
    over_rollouts,
)
from wasp_cli.operators.base import DrawnNoise
from wasp_cli.operators.laggy import LaggyOperator

H, L, M, N, B = 6, 3, 2, 4, 3
PLACES = (0.0, 0.2, 0.5)
JITTER = 0.05


def policy(features: Tensor) -> Tensor:
    return (1.2 - features[:, :1]).clamp(-1, 1)


IMAGINATION = Imagination(
    Corridor(0.3, 0.6, JITTER, torch.float64), LinearCritics(), policy, 0.9, 0.8, 0.7
)


def laggy(p: float) -> LaggyOperator:
    operator = LaggyOperator(policy, 1, DrawnNoise(torch.zeros(1, B, 1, dtype=torch.float64)), B)
    operator.p = p
    operator.memory = {
        "last": torch.tensor([[0.2], [-0.4], [0.9]], dtype=torch.float64),
        "started": torch.ones(B, 1, dtype=torch.bool),
    }
    return operator


def started(operator: LaggyOperator) -> Situation:
    at = IMAGINATION.model.at(*PLACES)
    return Situation(at, operator.memory["last"].clone(), operator, torch.arange(B))


def drawn() -> Draws:
    source = torch.Generator().manual_seed(0)
    return Draws(
        torch.randn(B, H, M, 2, generator=source, dtype=torch.float64),
        torch.rand(B, H, M, 1, generator=source, dtype=torch.float64),
    )


@pytest.mark.parametrize("held", [False, True])
def test_every_candidate_equals_the_literal_rollout(held):
    """Corrections of the commands of the moment, and of the held first one (Eq. 13 as printed)."""
    residuals = 1.5 * torch.randn(
        B, N, L, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    operator, draws = laggy(0.5), drawn()
    start = started(operator)
    delta, now = over_rollouts(residuals, M), start.a_h.repeat_interleave(N * M, 0)
    compose: Compose = (
        (lambda k, a: now + delta[:, k] if k < L else a) if held else corrected(residuals, draws)
    )
    found = IMAGINATION.roll(start, N, compose, draws)
    reward, cost, value = found.reward(), found.cost(), found.value_r()
    for b in range(B):
        for n in range(N):
            for m in range(M):
                x, last = PLACES[b], float(start.a_h[b])
                for k in range(H):
                    if k and float(draws.operator[b, k - 1, m]) >= 0.5:
                        last = min(1.0, max(-1.0, 1.2 - x))
                    base = float(start.a_h[b]) if held and k < L else last
                    action = min(
                        1.0, max(-1.0, base + (float(residuals[b, n, k]) if k < L else 0.0))
                    )
                    x = x + 0.1 * action + JITTER * float(draws.latent[b, k, m, 0])
                    got = (
                        float(reward[k, b, n, m]),
                        float(cost[k, b, n, m]),
                        float(value[k, b, n, m]),
                    )
                    assert got == pytest.approx((0.1 * action, float(0.3 < x < 0.6), 0.5 * x))


def test_a_selection_of_decisions_is_imagined_as_among_all():
    start, draws, rows = started(laggy(0.4)), drawn(), torch.tensor([2, 0])
    every = IMAGINATION.roll(start, 1, lambda k, command: command, draws).reward()
    some = IMAGINATION.roll(
        start.select(rows), 1, lambda k, command: command, draws.rows(rows)
    ).reward()
    torch.testing.assert_close(some, every[:, rows], rtol=0, atol=0)
