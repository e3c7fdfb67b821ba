"""What a learned safety value foresees of the costs that followed. K decisions."""

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
CHUNK = 4096  # held-out decisions that are looked at together


@torch.inference_mode()
def safety_quality(
    value: SafetyValue, recording: Recording, latents: Latents, heldout: Heldout
) -> dict[str, dict[str, float | None]]:
    """Return what Q of the executed action foresees, on held-out episodes of the dataset
    (`recorded`) and of the expert (`expert`).

    `auc` is the chance that of two decisions, one with a cost among the `AHEAD` decisions that
    begin with it and one without, Q ranks the first lower; `ap` the average precision of the same,
    beside its base rate `costly`. An onset is a costly decision with none among the five before it;
    `foreseen_k` is the share of onsets with an alarm k decisions before, at a threshold below which
    one in twenty decisions without cost ahead lies. None where nothing costs, or everything.
    """
    # The action at row i + 1 is what was executed at the state of row i.
    rows = np.flatnonzero(
        recording.held_out(HELD_OUT)[:-1] & (recording.episode[1:] == recording.episode[:-1])
    )
    index = torch.from_numpy(rows)
    parts = [
        value(latents.at(some).features, torch.from_numpy(recording.action)[some + 1].unsqueeze(1))
        for some in index.split(CHUNK)
    ]
    recorded = torch.cat(parts).squeeze(1).numpy()
    driven = value(heldout.latent.features, heldout.a_h.unsqueeze(1)).squeeze(1).numpy()
    return {
        "recorded": foresight(recorded, recording.cost[rows + 1], recording.episode[rows]),
        "expert": foresight(driven, heldout.cost.numpy(), heldout.episode.numpy()),
    }


def foresight(
    q: NDArray[Any], cost: NDArray[Any], episode: NDArray[Any]
) -> dict[str, float | None]:
    """Return the figures of `safety_quality` for values [K] of decisions whose costs [K] and
    episodes [K] are known.
    """
    ahead = sums_ahead(cost, episode, AHEAD)
    known = ~np.isnan(ahead)
    event = ahead[known] > 0
    danger = -q[known]
    found: dict[str, float | None] = {
        "decisions": float(len(event)),
        "costly": float(event.mean()) if len(event) else None,
    }
    if not 0 < event.sum() < len(event):
        return found | {"auc": None, "ap": None}
    _, place, counts = np.unique(danger, return_inverse=True, return_counts=True)
    rank = (np.cumsum(counts) - (counts - 1) / 2)[place]  # ties share the mean of their ranks
    positives = int(event.sum())
    negatives = int((~event).sum())
    auc = (rank[event].sum() - positives * (positives + 1) / 2) / (positives * negatives)
    alarm = -q > np.quantile(danger[~event], 0.95)
    onsets = [
        t
        for t in np.flatnonzero(cost > 0)
        if t >= QUIET and episode[t - QUIET] == episode[t] and not cost[t - QUIET : t].any()
    ]
    lead = {
        f"foreseen_{k}": float(alarm[np.array(onsets) - k].mean()) if onsets else None
        for k in (0, 1, 2, 3, 5)
    }
    return found | {"auc": float(auc), "ap": average_precision(event, danger), **lead}
