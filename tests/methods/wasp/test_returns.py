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
def test_td_lambda_is_equation_8(horizon, gamma, lam):
    source = torch.Generator().manual_seed(horizon)
    signal = torch.randn(horizon, 3, 4, generator=source, dtype=torch.float64)
    value = torch.randn(horizon + 1, 3, 4, generator=source, dtype=torch.float64)
    found = td_lambda(signal, value[1:], gamma, lam)
    for i in range(3):
        for j in range(4):
            wanted = literal(signal[:, i, j].tolist(), value[:, i, j].tolist(), gamma, lam)
            assert found[i, j].item() == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("lam", [0.95, 0.3, 1.0])
def test_continuation_is_a_discount_of_its_own(lam):
    """Against the mixture of n-step returns, each written out: G = (1 - lam) sum_n lam^(n-1)
    G_n + lam^(H-1) G_H.
    """
    source = torch.Generator().manual_seed(4)
    horizon, gamma = 6, 0.9
    signal, value, keep = (
        torch.rand(horizon, 5, generator=source, dtype=torch.float64) for _ in range(3)
    )
    found = td_lambda_all(signal, value, gamma, lam, keep)
    for k in range(horizon):
        wanted, weights = torch.zeros(5, dtype=torch.float64), 0.0
        for n in range(1, horizon - k + 1):
            discount, n_step = (
                torch.ones(5, dtype=torch.float64),
                torch.zeros(5, dtype=torch.float64),
            )
            for i in range(k, k + n):
                n_step = n_step + discount * signal[i]
                discount = discount * gamma * keep[i]
            n_step = n_step + discount * value[k + n - 1]
            weight = lam ** (n - 1) * (1 - lam if k + n < horizon else 1.0)
            wanted, weights = wanted + weight * n_step, weights + weight
        assert weights == pytest.approx(1.0)
        torch.testing.assert_close(found[k], wanted)
    torch.testing.assert_close(
        td_lambda_all(signal, value, gamma, lam, torch.ones_like(keep)),
        td_lambda_all(signal, value, gamma, lam),
    )


def test_the_plain_sum_counts_costly_steps():
    assert discounted_sum(torch.tensor([[0.0], [1.0], [1.0]]), 0.95).item() == pytest.approx(
        0.95 + 0.95**2
    )
