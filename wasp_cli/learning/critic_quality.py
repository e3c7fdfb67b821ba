"""What critics are worth: V_r and V_c beside the discounted sums that really followed on held-out episodes of the expert."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.methods.base import Heldout
from wasp_cli.models.base import Critics

CUT_OFF = 0.05
"""Largest share of a discounted return that may lie beyond the time limit."""
BINS = 10

Floats = NDArray[np.float64]


class Pairs(NamedTuple):
    """Predicted and real returns of K decisions, as far as their future was recorded."""

    predicted: Floats
    real: Floats
    cut_off: float
    """Largest share of a real return that lay beyond the time limit."""


def returns_ahead(signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float) -> tuple[Floats, Floats]:
    """The discounted sum from every decision to its episode's end, and gamma^n where the time limit came n decisions later.

    Args:
        signal: [K] what each decision scored, episodes one after the other.
        episode: [K] number of the episode.
        terminal: [K] the decision ended the episode by the task's own rule, after which nothing follows.
        gamma: discount per decision.

    Returns:
        Sums [K] and the shares [K] of the return that lie beyond the time limit; 0 where the episode ended by itself.
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


def pairs(predicted: Floats, signal: Floats, episode: NDArray[Any], terminal: NDArray[Any], gamma: float) -> Pairs:
    """Predictions beside the real returns, without decisions whose return the time limit cuts.

    At most `CUT_OFF` of a return may be cut. Where episodes are too short for that, what half of the longest one cuts is allowed. What is
    cut is filled up with the mean of the signal, which favours no state.
    """
    sums, beyond = returns_ahead(signal, episode, terminal, gamma)
    longest = int(np.unique(episode, return_counts=True)[1].max())
    whole = beyond <= (1 + 1e-9) * max(CUT_OFF, gamma ** (longest / 2))  # a product of many factors is not quite their power
    real = sums + (beyond * signal.mean() / (1 - gamma) if gamma < 1 else 0.0)
    return Pairs(predicted[whole], real[whole], float(beyond[whole].max(initial=0.0)))


@torch.inference_mode()
def heldout_pairs(critics: Critics, heldout: Heldout, returns: ReturnsConfig) -> dict[str, Pairs]:
    """The pairs of V_r and V_c, by 'r' and 'c'."""
    episode, terminal = heldout.episode.numpy(), heldout.terminal.numpy()
    values = {"r": critics.value_r(heldout.latent), "c": critics.value_c(heldout.latent)}
    signals = {"r": (heldout.reward, returns.gamma_r), "c": (heldout.cost, returns.gamma_c)}
    return {
        name: pairs(values[name].double().numpy(), signal.double().numpy(), episode, terminal, gamma)
        for name, (signal, gamma) in signals.items()
    }


def quality(found: Pairs) -> dict[str, float | None]:
    """Rank correlation and mean predicted / mean real; None where too few decisions or no variation leave them undefined."""
    enough = len(found.real) >= 10 and np.ptp(found.real) > 0 and np.ptp(found.predicted) > 0
    mean = float(found.real.mean()) if len(found.real) else 0.0
    return {
        "rank": spearman(found.predicted, found.real) if enough else None,
        "predicted_over_real": float(found.predicted.mean()) / mean if mean else None,
        "real_mean": mean, "decisions": len(found.real), "cut_off": found.cut_off,
    }  # fmt: skip


def spearman(a: Floats, b: Floats) -> float:
    """Rank correlation, ties at their average rank: discounted costs have many exact ties at zero."""
    return float(np.corrcoef(_ranks(a), _ranks(b))[0, 1])


def _ranks(values: Floats) -> Floats:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts).astype(np.float64)
    average: Floats = (last - (counts - 1) / 2)[inverse]
    return average


def reliability_picture(found: dict[str, Pairs], path: Path) -> None:
    """Every decision as a point, and the means of ten equally large groups by prediction; on the diagonal critics are right on average.

    Args:
        found: by the name of the critic.
        path: of the PNG.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(found), 3.8), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(found), squeeze=False)[0]
    for panel, (name, (predicted, real, _)) in zip(panels, found.items(), strict=True):
        if not len(real):
            continue
        shown = np.linspace(0, len(real) - 1, min(1500, len(real))).astype(int)
        panel.plot(predicted[shown], real[shown], ".", color="#56B4E9", markersize=2, alpha=0.4)
        groups = [group for group in np.array_split(np.argsort(predicted, kind="stable"), BINS) if len(group)]
        panel.plot([predicted[g].mean() for g in groups], [real[g].mean() for g in groups], "o-", color="#D55E00", markersize=4)
        ends = [min(predicted.min(), real.min()), max(predicted.max(), real.max())]
        panel.plot(ends, ends, color="#000000", linewidth=0.7)
        panel.set_xlabel(f"{name}, predicted")
        panel.set_ylabel("discounted sum that followed")
    figure.savefig(path, metadata={"Software": None})
