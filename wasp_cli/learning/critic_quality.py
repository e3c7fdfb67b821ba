"""What critics are worth: V_r and V_c beside the discounted sums that really followed on
held-out episodes of the expert.
"""

from __future__ import annotations

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


class Pairs(NamedTuple):
    """Predicted and real returns of K decisions, as far as their future was recorded."""

    predicted: Floats
    real: Floats
    episode: NDArray[Any]  # [K]
    cut_off: float  # largest share of a real return that lay beyond the time limit


def returns_ahead(
    signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float
) -> tuple[Floats, Floats]:
    """Return the discounted sum from every decision to its episode's end, and gamma^n where the
    time limit came n decisions later.

    Args:
        signal: [K] what each decision scored, episodes one after the other.
        episode: [K] number of the episode.
        terminal: [K] the decision ended the episode by the task's own rule, after which nothing
            follows.

    Returns:
        Sums [K] and the shares [K] of the return that lie beyond the time limit; 0 where the
        episode ended by itself.
    """
    sums, beyond = np.zeros(len(signal)), np.zeros(len(signal))
    total = weight = 0.0
    for k in range(len(signal) - 1, -1, -1):
        if k == len(signal) - 1 or episode[k + 1] != episode[k]:
            total, weight = 0.0, 0.0 if terminal[k] else 1.0
        total = float(signal[k]) + gamma * total
        weight *= gamma
        sums[k], beyond[k] = total, weight
    return sums, beyond


def whole_returns(
    signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float
) -> tuple[Floats, NDArray[np.bool_], float]:
    """Return what really followed every decision, and where the time limit cuts so little of it
    that it counts.

    At most `CUT_OFF` of a return may be cut. Where episodes are too short for that, what half of
    the longest one cuts is allowed. What is cut is filled up with the mean of the signal, which
    favours no state. Arguments as in `returns_ahead`.

    Returns:
        Returns [K], where they count [K], and the largest share that is cut of one that counts.
    """
    sums, beyond = returns_ahead(signal, episode, terminal, gamma)
    longest = int(np.unique(episode, return_counts=True)[1].max(initial=0))
    # a product of many factors is not quite their power
    whole = beyond <= (1 + 1e-9) * max(CUT_OFF, gamma ** (longest / 2))
    filled = sums + (beyond * signal.mean() / (1 - gamma) if gamma < 1 and len(signal) else 0.0)
    return filled, whole, float(beyond[whole].max(initial=0.0))


def pairs(
    predicted: Floats, signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float
) -> Pairs:
    """Pair predictions [N] with real returns [N], without decisions whose return the time limit
    cuts (see `whole_returns`).
    """
    real, whole, cut_off = whole_returns(signal, episode, terminal, gamma)
    return Pairs(predicted[whole], real[whole], episode[whole], cut_off)


@torch.inference_mode()
def heldout_pairs(critics: Critics, heldout: Heldout, returns: ReturnsConfig) -> dict[str, Pairs]:
    """Return the pairs of V_r and V_c, by 'r' and 'c'."""
    episode, terminal = heldout.episode.numpy(), heldout.terminal.numpy()
    values = {"r": critics.value_r(heldout.latent), "c": critics.value_c(heldout.latent)}
    signals = {"r": (heldout.reward, returns.gamma_r), "c": (heldout.cost, returns.gamma_c)}
    return {
        name: pairs(
            values[name].double().numpy(), signal.double().numpy(), episode, terminal, gamma
        )
        for name, (signal, gamma) in signals.items()
    }


def quality(found: Pairs) -> dict[str, float | None]:
    """Return rank correlation and mean predicted / mean real, each with a 95 % interval over
    resampled episodes.

    None where too few decisions, no variation or a single episode leave a number undefined. A few
    episodes may make most of the cost, so that thousands of decisions may say little of either.
    """
    enough = len(found.real) >= 10 and np.ptp(found.real) > 0 and np.ptp(found.predicted) > 0
    mean = float(found.real.mean()) if len(found.real) else 0.0
    ranked = correlations(found.predicted, found.real, found.episode, resamples=RESAMPLES)
    place, drawn = cluster_draws(found.episode, RESAMPLES)
    predicted, real = (
        drawn @ np.bincount(place, values) for values in (found.predicted, found.real)
    )
    numbers = {
        "rank": ranked.rank if enough else None,
        **_interval("rank", ranked.resampled[:, 1]),
        "predicted_over_real": float(found.predicted.mean()) / mean if mean else None,
        **_interval("predicted_over_real", predicted[real != 0] / real[real != 0]),
    }
    return {**numbers, "real_mean": mean, "decisions": len(found.real), "cut_off": found.cut_off}


def _interval(name: str, resampled: Floats) -> dict[str, float | None]:
    low, high = percentiles(resampled[np.isfinite(resampled)])
    return {
        f"{name}_low": None if np.isnan(low) else low,
        f"{name}_high": None if np.isnan(high) else high,
    }


def write_pairs(path: Path, found: Mapping[str, Pairs]) -> None:
    """Write the pairs of every critic to a Parquet file: `critic` (its name), `predicted` and
    `real` (float64), a row per decision.
    """
    columns = {
        "critic": pa.array([name for name, one in found.items() for _ in one.real], pa.string()),
        "predicted": pa.array(
            np.concatenate([one.predicted for one in found.values()]), pa.float64()
        ),
        "real": pa.array(np.concatenate([one.real for one in found.values()]), pa.float64()),
    }
    pq.write_table(
        pa.table(columns), path, compression="zstd", compression_level=3, use_dictionary=["critic"]
    )
