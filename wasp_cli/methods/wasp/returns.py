"""Returns of imagined rollouts: TD-lambda (Eq. 7-8), the same for reward and cost, and a discounted
sum without a critic behind it.
"""

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
    future = value[-1]  # Eq. 7
    returns = []
    for k in range(len(signal) - 1, -1, -1):
        onward = (1 - lam) * value[k] + lam * future
        if keep is not None:
            onward = keep[k] * onward
        future = signal[k] + gamma * onward
        returns.append(future)
    returns.reverse()
    return torch.stack(returns)


def discounted_sum(signal: Tensor, gamma: float, keep: Tensor | None = None) -> Tensor:
    """Return sum_k gamma^k x_{t+k}, [...]: Eq. 8 with lambda = 1 and nothing beyond the horizon.

    Args:
        signal: x-hat_{t+k} for k = 0..H-1: [H, ...].
        gamma: discount per decision step.
        keep: as in `td_lambda`, [H, ...].
    """
    onward = torch.full_like(signal, gamma) if keep is None else gamma * keep
    future = signal[-1]
    for k in range(len(signal) - 2, -1, -1):
        future = torch.addcmul(signal[k], onward[k], future)
    return future
