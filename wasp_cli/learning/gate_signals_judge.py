"""How well each signal of a gate foresees whether a cost follows, or what is earned, and what the gate's own value is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.learning.closed_loop import Loop
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.critic_quality import whole_returns
from wasp_cli.learning.gate_signals import GATE
from wasp_cli.metrics.ranking import average_precision, average_precision_resampled, correlations, percentiles, recall_at
from wasp_cli.metrics.windows import sums_ahead

POOLED = "all"
"""The set of all operators together."""
FALSE_ALARMS = 0.1
"""Share of the decisions without a cost ahead at which a recall is read."""
RESAMPLES = 400
"""Of whole episodes, per interval."""
SWEEP = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0)
"""Thresholds at which a gate is looked at besides its own."""
GROUPS = 10
"""Groups of equally many decisions in a reliability curve."""

Floats = NDArray[Any]
Bools = NDArray[np.bool_]
Row = dict[str, Any]


class SignalRows(NamedTuple):
    """K decisions whose next W are known, with what was signalled at them."""

    signals: dict[str, Floats]
    """[K] of the cost, by name"""
    promised: dict[str, Floats]
    """[K] of the return, by name"""
    before: NDArray[np.bool_]
    """[K] the decision before cost: there is nothing to foresee any more"""
    ahead: Floats
    """[K] costly decisions among the W that begin with this one"""
    discounted: Floats
    """[K] sum_k gamma_c^k c_{t+k} over them"""
    earned: Floats
    """[K] sum_k gamma_r^k r_{t+k} over them"""
    rest: Floats
    """[K] the same to the end of the episode; NaN where the time limit cuts too much of it"""
    episode: NDArray[np.int64]
    """[K]"""


def signal_rows(
    loop: Loop,
    seen: Sequence[Mapping[str, Tensor]],
    promised: Sequence[Mapping[str, Tensor]],
    window: int,
    returns: ReturnsConfig,
    first: int = 0,
) -> SignalRows:
    """Pair the decisions of B episodes with the costs and rewards that followed.

    Those after which a time limit cuts the window off are left out. Where an episode ended by the task's own rule nothing follows, and its
    last decisions count.

    Args:
        loop: the recorded episodes.
        seen: [T] signals [B] of the cost by name.
        promised: [T] signals [B] of the return by name.
        window: W.
        returns: discounts.
        first: number of the first episode.
    """
    columns, others = ({name: torch.stack([row[name] for row in rows]).double().numpy() for name in rows[0]} for rows in (seen, promised))
    alive = loop.alive.T.astype(bool)  # [B, T]
    episode = np.broadcast_to(np.arange(len(alive))[:, None], alive.shape)[alive]
    reward, terminal = loop.reward.T[alive].astype(np.float64), loop.terminated.T[alive]
    real, whole, _ = whole_returns(reward, episode, terminal, returns.gamma_r)
    rest = np.where(whole, real, np.nan)
    parts = [_episode(loop, columns, others, rest[episode == row], row, window, returns) for row in range(len(alive))]
    return joined([part._replace(episode=part.episode + first) for part in parts])


def joined(parts: Sequence[SignalRows]) -> SignalRows:
    """Join the decisions of all parts, one part after the other."""

    def of(columns: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
        return {name: np.concatenate([column[name] for column in columns]) for name in columns[0]}

    signals, promised = of([part.signals for part in parts]), of([part.promised for part in parts])
    return SignalRows(signals, promised, *(np.concatenate(fields) for fields in zip(*(part[2:] for part in parts), strict=True)))


def _episode(
    loop: Loop,
    columns: Mapping[str, Floats],
    others: Mapping[str, Floats],
    rest: Floats,
    row: int,
    window: int,
    returns: ReturnsConfig,
) -> SignalRows:
    length = int(loop.alive[:, row].sum())
    cost, reward = loop.cost[:length, row].astype(np.float64), loop.reward[:length, row].astype(np.float64)
    after = np.zeros(window - 1 if loop.terminated[:length, row].any() else 0)
    padded = np.concatenate([cost, after])
    ahead = sums_ahead(padded, np.zeros(len(padded)), window)[:length]
    known = np.flatnonzero(~np.isnan(ahead))

    def discounted(values: Floats, gamma: float) -> Floats:
        # `convolve` runs its kernel backwards; entry t is the sum over the window that begins at t.
        return np.convolve(values, gamma ** np.arange(window)[::-1], "valid") if len(known) else np.zeros(0)

    before = np.concatenate([[False], cost[:-1] > 0])[known]
    signals, promised = ({name: column[known, row] for name, column in named.items()} for named in (columns, others))
    costs, earned = discounted(padded, returns.gamma_c), discounted(np.concatenate([reward, after]), returns.gamma_r)
    return SignalRows(signals, promised, before, ahead[known], costs[known], earned[known], rest[known], np.full(len(known), row))


def judged(rows: SignalRows, threshold: float, rival: str, task_gate: str) -> Row:
    """Judge every signal, the gate at its threshold and at others, and its reliability.

    `base` is the share of the decisions with a cost among the next W, `auprc` that of a signal for it with a 95 % interval over resampled
    episodes, `recall` is read at FALSE_ALARMS. `behind` is by how much the AUPRC is below the gate's own, on the same resampled episodes.
    With `onset_` only decisions count before which there was no cost.

    Args:
        rows: the decisions.
        threshold: tau_c.
        rival: a signal that is looked at beside the gate's own: at the threshold at which it fires as often, and at all the others.
        task_gate: the signal of the return beside which the others are judged.
    """
    event, calm = rows.ahead > 0, ~rows.before
    own = rows.signals[GATE]
    table: Row = {"episodes": len(np.unique(rows.episode)), "decisions": len(event), "base": _mean(event), "onset_base": _mean(event[calm])}
    resampled = average_precision_resampled(event, own, rows.episode, resamples=RESAMPLES)
    table["signals"] = {name: _ranked(rows, score, resampled) for name, score in rows.signals.items()}
    real = float(rows.discounted.mean()) if len(event) else float("nan")
    table["gate"] = alarms(rows, GATE, threshold) | {"predicted_over_real": _mean(own) / real if real else float("nan")}
    alike = float(np.quantile(rows.signals[rival], 1.0 - table["gate"]["fires"])) if len(event) else float("nan")
    table["rival"] = alarms(rows, rival, alike)
    table["sweep"] = {name: [alarms(rows, name, value) for value in SWEEP] for name in (GATE, rival)}
    table["returns"] = {
        "window": _foreseen(rows.promised, rows.earned, rows.episode, task_gate),
        "rest": _foreseen(rows.promised, rows.rest, rows.episode, task_gate),
    }
    return table | {"reliability": reliability_groups(own, rows.discounted, event)}


def alarms(rows: SignalRows, name: str, threshold: float) -> Row:
    """Judge a gate that fires where a signal is above a threshold.

    `fires` is the share of all decisions, `precision` how many of these a cost followed, `foreseen` the share of the decisions before a
    cost at which it fires, `false_alarms` the share of the others.
    """
    event, calm, up = rows.ahead > 0, ~rows.before, rows.signals[name] > threshold
    return {
        "threshold": threshold, "fires": _mean(up), "precision": _mean(event[up]),
        "foreseen": _mean(up[event]), "false_alarms": _mean(up[~event]),
        "onset_foreseen": _mean(up[event & calm]), "onset_false_alarms": _mean(up[~event & calm]),
    }  # fmt: skip


def reliability_groups(predicted: Floats, real: Floats, event: Bools) -> list[Row]:
    """Form ten groups of equal size by prediction [N]: mean prediction, mean of what followed, share of decisions with any cost."""
    groups = [group for group in np.array_split(np.argsort(predicted, kind="stable"), GROUPS) if len(group)]
    return [{"predicted": _mean(predicted[g]), "real": _mean(real[g]), "any": _mean(event[g]), "size": len(g)} for g in groups]


def _foreseen(promised: Mapping[str, Floats], real: Floats, episode: NDArray[np.int64], own: str) -> Row:
    """Correlate every signal of the return with what was really earned [K], NaN where that is not known.

    `pearson` and `rank` come with 95 % intervals over resampled episodes; `behind` is by how much the Pearson correlation is below that of
    the signal `own`, on the same resampled episodes.
    """
    known = ~np.isnan(real)
    real, episode = real[known], episode[known]
    found = {name: correlations(score[known], real, episode, resamples=RESAMPLES) for name, score in promised.items()}
    mean = _mean(real)
    rows: Row = {}
    for name, each in found.items():
        # A resample in which nothing varies says nothing.
        draws = (each.resampled[:, 0], each.resampled[:, 1], found[own].resampled[:, 0] - each.resampled[:, 0])
        (low, high), (rank_low, rank_high), (behind_low, behind_high) = (percentiles(column[~np.isnan(column)]) for column in draws)
        rows[name] = {
            "pearson": each.pearson, "pearson_low": low, "pearson_high": high,
            "rank": each.rank, "rank_low": rank_low, "rank_high": rank_high,
            "behind": found[own].pearson - each.pearson, "behind_low": behind_low, "behind_high": behind_high,
            "predicted_over_real": _mean(promised[name][known]) / mean if mean else float("nan"),
        }  # fmt: skip
    return {"decisions": len(real), "real_mean": mean, "signals": rows}


def _ranked(rows: SignalRows, score: Floats, own: Floats) -> Row:
    """A signal's columns; `own` is the AUPRC of the gate's own signal on the resampled episodes."""
    event, calm = rows.ahead > 0, ~rows.before
    auprc = average_precision(event, score)
    resampled = average_precision_resampled(event, score, rows.episode, resamples=RESAMPLES)
    low, high = percentiles(resampled)
    behind_low, behind_high = percentiles(own - resampled)
    return {
        "auprc": auprc, "auprc_low": low, "auprc_high": high, "recall": recall_at(event, score, FALSE_ALARMS),
        "behind": average_precision(event, rows.signals[GATE]) - auprc, "behind_low": behind_low, "behind_high": behind_high,
        "onset_auprc": average_precision(event[calm], score[calm]), "onset_recall": recall_at(event[calm], score[calm], FALSE_ALARMS),
    }  # fmt: skip


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")
