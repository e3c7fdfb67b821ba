from __future__ import annotations

import pytest
import torch

from wasp_cli.methods.wasp.returns import discounted_sum, td_lambda, td_lambda_all


def literal(signal: list[float], value: list[float], gamma: float, lam: float) -> float:
    """Eq. 7-8 word for word: value[k] is V at step k, k = 0..H; signal[k] is x-hat_{t+k}."""
    horizon = len(signal)
    g = value[horizon]
    for k in reversed(range(horizon)):
        g = signal[k] + gamma * ((1 - lam) * value[k + 1] + lam * g)
    return g


@pytest.mark.parametrize("horizon", [1, 2, 15])
@pytest.mark.parametrize(("gamma", "lam"), [(0.99, 0.95), (0.95, 1.0), (1.0, 0.3)])
def test_td_lambda_is_equation_8(horizon: int, gamma: float, lam: float) -> None:
    source = torch.Generator().manual_seed(horizon)
    signal = torch.randn(horizon, 3, 4, generator=source, dtype=torch.float64)
    value = torch.randn(horizon + 1, 3, 4, generator=source, dtype=torch.float64)
    found = td_lambda(signal, value[1:], gamma, lam)
    for i in range(3):
        for j in range(4):
            wanted = literal(signal[:, i, j].tolist(), value[:, i, j].tolist(), gamma, lam)
            assert found[i, j].item() == pytest.approx(wanted, rel=1e-12)


def test_every_intermediate_return_is_the_return_of_the_rest() -> None:
    signal, value = torch.randn(6, 2, dtype=torch.float64), torch.randn(6, 2, dtype=torch.float64)
    every = td_lambda_all(signal, value, 0.9, 0.8)
    for k in range(6):
        torch.testing.assert_close(every[k], td_lambda(signal[k:], value[k:], 0.9, 0.8))


def test_lambda_mixes_bootstrap_and_monte_carlo() -> None:
    signal, value = torch.ones(3, 1), torch.full((3, 1), 10.0)
    assert td_lambda(signal, value, 0.5, 1.0).item() == pytest.approx(1 + 0.5 + 0.25 + 0.125 * 10)
    assert td_lambda(signal, value, 0.5, 1e-12).item() == pytest.approx(1 + 0.5 * 10)


def test_the_plain_sum_counts_costly_steps() -> None:
    assert discounted_sum(torch.tensor([[0.0], [1.0], [1.0]]), 0.95).item() == pytest.approx(0.95 + 0.95**2)
