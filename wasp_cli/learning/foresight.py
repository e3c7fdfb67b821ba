"""How well a learned safety value predicts the costs that followed. K decisions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.latents import Latents
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.methods.base import Heldout
from wasp_cli.metrics.ranking import average_precision
from wasp_cli.metrics.windows import sums_ahead
from wasp_cli.models.reachability import SafetyValue

AHEAD = 15  # W: decisions within which a cost counts as ahead (section 5.3)
QUIET = 5  # decisions without cost before an onset
CHUNK = 4096  # held-out decisions that are evaluated together
LEADS = (0, 1, 2, 3, 5)  # decisions before an onset at which the alarm is read


@torch.inference_mode()
def safety_quality(
    value: SafetyValue, recording: Recording, latents: Latents, heldout: Heldout
) -> dict[str, dict[str, float | None]]:
    """Return how well Q of the executed action predicts costs, on held-out episodes of the dataset
    (`recorded`) and of the expert (`expert`).

    A decision counts as before a cost if one of the `AHEAD` decisions that begin with it costs.
    `auc` is the probability that Q ranks a decision before a cost lower than another one; `ap` is
    the average precision of the same, and `costly` its base rate. An onset is a costly decision
    with none among the `QUIET` before it. `foreseen_k` is the share of onsets with an alarm k
    decisions before; the alarm is up at one in twenty decisions that are not before a cost. None
    where no decision costs, or all do.
    """
    # -- held-out decisions; the action at row i + 1 is what was executed at the state of row i
    same_episode = recording.episode[1:] == recording.episode[:-1]
    rows = np.flatnonzero(recording.held_out(HELD_OUT)[:-1] & same_episode)

    # -- their values, and those of the expert's
    action = torch.from_numpy(recording.action)
    parts = [
        value(latents.at(some).features, action[some + 1].unsqueeze(1))
        for some in torch.from_numpy(rows).split(CHUNK)
    ]
    recorded = torch.cat(parts).squeeze(1).numpy()
    expert = value(heldout.latent.features, heldout.a_h.unsqueeze(1)).squeeze(1).numpy()
    return {
        "recorded": foresight(recorded, recording.cost[rows + 1], recording.episode[rows]),
        "expert": foresight(expert, heldout.cost.numpy(), heldout.episode.numpy()),
    }


def foresight(
    q: NDArray[Any], cost: NDArray[Any], episode: NDArray[Any]
) -> dict[str, float | None]:
    """Return the numbers of `safety_quality` for K decisions.

    Args:
        q: [K] values of the executed actions.
        cost: [K] whether each decision cost.
        episode: [K] numbers of the episodes.
    """
    # -- decisions whose next `AHEAD` decisions were recorded
    ahead = sums_ahead(cost, episode, AHEAD)
    recorded = ~np.isnan(ahead)
    event = ahead[recorded] > 0
    danger = -q[recorded]
    numbers: dict[str, float | None] = {
        "decisions": float(len(event)),
        "costly": float(event.mean()) if len(event) else None,
    }
    if not 0 < event.sum() < len(event):
        return numbers | {"auc": None, "ap": None}

    # -- the area under the curve, from ranks; ties share the mean of their ranks
    _, place, counts = np.unique(danger, return_inverse=True, return_counts=True)
    rank = (np.cumsum(counts) - (counts - 1) / 2)[place]
    positives = int(event.sum())
    negatives = int((~event).sum())
    auc = (rank[event].sum() - positives * (positives + 1) / 2) / (positives * negatives)
    numbers["auc"] = float(auc)
    numbers["ap"] = average_precision(event, danger)

    # -- alarms before the onsets
    alarm = -q > np.quantile(danger[~event], 0.95)
    costly = np.flatnonzero(cost > 0).tolist()
    onsets = [t for t in costly if _is_onset(t, cost, episode)]
    for k in LEADS:
        share = float(alarm[np.array(onsets) - k].mean()) if onsets else None
        numbers[f"foreseen_{k}"] = share
    return numbers


def _is_onset(t: int, cost: NDArray[Any], episode: NDArray[Any]) -> bool:
    """Return whether none of the `QUIET` decisions before decision t costs."""
    if t < QUIET or episode[t - QUIET] != episode[t]:
        return False
    return not cost[t - QUIET : t].any()
