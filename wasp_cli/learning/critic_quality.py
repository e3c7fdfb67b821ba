"""Quality of critics: V_r and V_c compared with the discounted sums that really followed on
held-out episodes of the expert. K decisions.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray

from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.methods.base import Heldout
from wasp_cli.metrics.ranking import cluster_draws, correlations, percentiles
from wasp_cli.models.base import Critics

CUT_OFF = 0.05  # largest share of a discounted return that may lie beyond the time limit
RESAMPLES = 400  # of whole episodes, per interval

Floats = NDArray[np.float64]


class ReturnsAhead(NamedTuple):
    """Discounted sums from K decisions to the ends of their episodes."""

    sums: Floats  # [K]
    beyond: Floats  # [K] share of the return beyond the time limit; 0 where the episode ended


class WholeReturns(NamedTuple):
    """Returns of K decisions, with what the time limit cuts filled up."""

    returns: Floats  # [K]
    counts: NDArray[np.bool_]  # [K] the time limit cuts so little that the return counts
    cut_off: float  # largest share that is cut of a return that counts


class Pairs(NamedTuple):
    """Predicted and real returns of K decisions, as far as their future was recorded."""

    predicted: Floats
    real: Floats
    episode: NDArray[Any]  # [K]
    cut_off: float  # largest share of a real return that lay beyond the time limit


def returns_ahead(
    signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float
) -> ReturnsAhead:
    """Return the discounted sum from every decision to the end of its episode, and the share of the
    return that lies beyond: gamma^n where the time limit came n decisions later, 0 where the
    episode ended by the task's own rule.

    Args:
        signal: [K] what each decision scored, episodes one after the other.
        episode: [K] number of the episode.
        terminal: [K] the decision ended the episode by the task's own rule, after which nothing
            follows.
        gamma: discount per decision.
    """
    sums = np.zeros(len(signal))
    beyond = np.zeros(len(signal))
    total = 0.0
    weight = 0.0
    for k in range(len(signal) - 1, -1, -1):
        is_last = k == len(signal) - 1 or episode[k + 1] != episode[k]
        if is_last:
            total = 0.0
            weight = 0.0 if terminal[k] else 1.0
        total = float(signal[k]) + gamma * total
        weight *= gamma
        sums[k] = total
        beyond[k] = weight
    return ReturnsAhead(sums, beyond)


def whole_returns(
    signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float
) -> WholeReturns:
    """Return what really followed every decision, and whether the time limit cuts so little of it
    that it counts.

    The time limit may cut at most `CUT_OFF` of a return, or where episodes are too short for that,
    what it cuts in the middle of the longest one. What is cut is filled up with the mean of the
    signal, which favours no state. Arguments as in `returns_ahead`.
    """
    ahead = returns_ahead(signal, episode, terminal, gamma)
    _, lengths = np.unique(episode, return_counts=True)
    longest = int(lengths.max(initial=0))
    most = max(CUT_OFF, gamma ** (longest / 2))
    counts = ahead.beyond <= (1 + 1e-9) * most  # `beyond` is a product, and `most` a power
    returns = ahead.sums + 0.0
    if gamma < 1 and len(signal):
        returns = ahead.sums + ahead.beyond * signal.mean() / (1 - gamma)
    return WholeReturns(returns, counts, float(ahead.beyond[counts].max(initial=0.0)))


def pairs(
    predicted: Floats, signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float
) -> Pairs:
    """Pair predictions [N] with real returns [N], without the decisions whose return does not count
    (see `whole_returns`).
    """
    real = whole_returns(signal, episode, terminal, gamma)
    counts = real.counts
    return Pairs(predicted[counts], real.returns[counts], episode[counts], real.cut_off)


@torch.inference_mode()
def heldout_pairs(critics: Critics, heldout: Heldout, returns: ReturnsConfig) -> dict[str, Pairs]:
    """Return the pairs of V_r and V_c, by 'r' and 'c'."""
    episode = heldout.episode.numpy()
    terminal = heldout.terminal.numpy()
    value_r = critics.value_r(heldout.latent).double().numpy()
    value_c = critics.value_c(heldout.latent).double().numpy()
    reward = heldout.reward.double().numpy()
    cost = heldout.cost.double().numpy()
    return {
        "r": pairs(value_r, reward, episode, terminal, returns.gamma_r),
        "c": pairs(value_c, cost, episode, terminal, returns.gamma_c),
    }


def quality(found: Pairs) -> dict[str, float | None]:
    """Return the rank correlation of predicted and real returns, and mean predicted / mean real,
    each with a 95 % interval over resampled episodes.

    A number is None where it is undefined: with too few decisions, without variation, or with a
    single episode. A few episodes may have most of the cost, so that even thousands of decisions
    may show little.
    """
    # -- rank correlation
    enough = len(found.real) >= 10 and np.ptp(found.real) > 0 and np.ptp(found.predicted) > 0
    ranked = correlations(found.predicted, found.real, found.episode, resamples=RESAMPLES)

    # -- ratio of the means, and of the sums over resampled episodes
    mean = float(found.real.mean()) if len(found.real) else 0.0
    place, drawn = cluster_draws(found.episode, RESAMPLES)
    predicted = drawn @ np.bincount(place, found.predicted)
    real = drawn @ np.bincount(place, found.real)
    ratios = predicted[real != 0] / real[real != 0]
    return {
        "rank": ranked.rank if enough else None,
        **_interval("rank", ranked.resampled[:, 1]),
        "predicted_over_real": float(found.predicted.mean()) / mean if mean else None,
        **_interval("predicted_over_real", ratios),
        "real_mean": mean,
        "decisions": len(found.real),
        "cut_off": found.cut_off,
    }


def _interval(name: str, resampled: Floats) -> dict[str, float | None]:
    """Return the bounds of the interval of a resampled number, by their names."""
    low, high = percentiles(resampled[np.isfinite(resampled)])
    return {
        f"{name}_low": None if np.isnan(low) else low,
        f"{name}_high": None if np.isnan(high) else high,
    }


def write_pairs(path: Path, found: Mapping[str, Pairs]) -> None:
    """Write the pairs of every critic to a Parquet file: `critic` (its name), `predicted` and
    `real` (float64), a row per decision.
    """
    names: list[str] = []
    for name, one in found.items():
        names.extend(itertools.repeat(name, len(one.real)))
    predicted = np.concatenate([one.predicted for one in found.values()])
    real = np.concatenate([one.real for one in found.values()])
    columns = {
        "critic": pa.array(names, pa.string()),
        "predicted": pa.array(predicted, pa.float64()),
        "real": pa.array(real, pa.float64()),
    }
    pq.write_table(
        pa.table(columns), path, compression="zstd", compression_level=3, use_dictionary=["critic"]
    )
