"""TD-lambda returns (Eq. 7-8), one function for reward and cost."""

from __future__ import annotations

import torch
from torch import Tensor


def td_lambda(
    signal: Tensor, value: Tensor, gamma: float, lam: float, keep: Tensor | None = None
) -> Tensor:
    """Return G_t of Eq. 8 for rollouts of H steps.

    Args:
        signal: x-hat_{t+k} for k = 0..H-1, read at the arrived state k + 1: [H, ...].
        value: V-hat at the arrived states k + 1 = 1..H: [H, ...]; the last row is the bootstrap of
            Eq. 7.
        gamma: discount per decision step.
        lam: lambda in (0, 1].
        keep: probability that the episode goes on after the arrived states k + 1 = 1..H, [H, ...];
            it multiplies the discount. Without it no episode ends.

    Returns:
        [...]: the return at k = 0.
    """
    return td_lambda_all(signal, value, gamma, lam, keep)[0]


def td_lambda_all(
    signal: Tensor, value: Tensor, gamma: float, lam: float, keep: Tensor | None = None
) -> Tensor:
    """Return G_{t+k} of Eq. 8 for every k = 0..H-1: [H, ...]; arguments as in `td_lambda`."""
    future = value[-1]
    found = []
    for k in range(len(signal) - 1, -1, -1):
        onward = (1 - lam) * value[k] + lam * future
        future = signal[k] + gamma * (onward if keep is None else keep[k] * onward)
        found.append(future)
    return torch.stack(found[::-1])


def discounted_sum(signal: Tensor, gamma: float, keep: Tensor | None = None) -> Tensor:
    """Return sum_k gamma^k x_{t+k} over [H, ...]: Eq. 8 with lambda = 1 and nothing beyond the
    horizon.
    """
    onward = torch.full_like(signal, gamma) if keep is None else gamma * keep
    future = signal[-1]
    for k in range(len(signal) - 2, -1, -1):
        future = torch.addcmul(signal[k], onward[k], future)
    return future


def quantile(values: Tensor, q: float) -> float:
    """Return a quantile of values [K]; NaN of nothing."""
    return float(torch.quantile(values, q)) if len(values) else float("nan")


def distributions(**values: Tensor) -> dict[str, float]:
    """Return median and upper tail of each of the values [K], as a calibration notes them."""
    shares = (("median", 0.5), ("p90", 0.90), ("p95", 0.95))
    return {
        f"{name}_{label}": quantile(each, q) for name, each in values.items() for label, q in shares
    }
