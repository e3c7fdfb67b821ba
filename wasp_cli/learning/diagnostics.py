"""How well a world model predicts costs, rewards and ends on recorded episodes, per imagined step
k = 1..H and over the whole window.

A forecast starts from the filtered latent of a recorded row, under the recorded actions; step k is
compared with what arrived k rows later. K starts, S cost sources.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.forecast import Forecast
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.observations import decoding_errors
from wasp_cli.learning.shards import Recording
from wasp_cli.metrics.ranking import average_precision, average_precision_interval, recall_at
from wasp_cli.metrics.reliability import calibration_error, reliability
from wasp_cli.models.world_model import SafetyWorldModel

FALSE_ALARMS = 0.1  # share of the moments without a cost at which a recall is read
CHUNK = 256  # filtered states that are judged together

Floats = NDArray[Any]
Bools = NDArray[np.bool_]
Row = dict[str, Any]


class Alarm(NamedTuple):
    """The rule of the safety gate, on imagined costs: Eq. 9 on Eq. 8 without a bootstrap."""

    threshold: float  # tau_c
    gamma: float  # gamma_c

    def up(self, cost: Floats) -> Bools:
        """Return whether costs [K, H] raise the alarm: [K]."""
        discounted = cost * self.gamma ** np.arange(cost.shape[1])
        raised: Bools = discounted.sum(1) > self.threshold
        return raised


def judge_steps(
    recording: Recording, seen: Forecast, alarm: Alarm, sources: Sequence[str]
) -> list[Row]:
    """Judge every imagined step.

    Args:
        recording: the recorded episodes.
        seen: the forecast on them.
        alarm: a cost is foreseen where the alarm was up before it.
        sources: names of the cost sources.

    Returns:
        A row per step `k`, over the starts whose episode was still going:

        - `base`: share of costly steps; `auprc`: average precision of the predicted cost, with
          `auprc_low` and `auprc_high`, a 95 % interval over resampled episodes; `persistence`: that
          of "the cost stays what it is at the start"; `recall` at `FALSE_ALARMS`;
          `predicted_over_base`, `calibration_error`, and `reliability`, a row per bin.
        - `foreseen`: share of the costs before which the alarm was up over the imagined window, and
          `foreseen_by_source`.
        - `onset_...`: the same over starts that do not cost themselves.
        - `reward_r2`, `reward_error` and `reward_variance`.
        - `ends_...`: of episodes that end by the task's own rule.
    """
    raised = alarm.up(seen.cost * seen.within)
    rows = []
    for step in range(seen.cost.shape[1]):
        # -- the starts whose episode was still going, and what followed
        going = seen.within[:, step]
        starts = seen.starts[going]
        follow = seen.follow[going, step]
        calm = recording.cost[starts] == 0
        alarmed = raised[going]

        # -- costs
        cost = seen.cost[going, step]
        event = recording.cost[follow] > 0
        base = _mean(event)
        bins = reliability(event, cost)
        low, high = average_precision_interval(event, cost, recording.episode[starts])
        by_source = {
            kind: _mean(alarmed[recording.sources[follow, i] > 0]) for i, kind in enumerate(sources)
        }

        # -- rewards
        reward = seen.reward[going, step]
        true_reward = recording.reward[follow]
        error = float(((reward - true_reward) ** 2).mean())
        variance = float(true_reward.var())

        # -- ends
        ends = seen.ends[going, step]
        over = recording.terminal[follow] > 0
        rows.append(
            {
                "k": step + 1,
                "base": base,
                "auprc": average_precision(event, cost),
                "auprc_low": low,
                "auprc_high": high,
                "persistence": average_precision(event, recording.cost[starts]),
                "onset_base": _mean(event[calm]),
                "onset_auprc": average_precision(event[calm], cost[calm]),
                "recall": recall_at(event, cost, FALSE_ALARMS),
                "onset_recall": recall_at(event[calm], cost[calm], FALSE_ALARMS),
                "foreseen": _mean(alarmed[event]),
                "onset_foreseen": _mean(alarmed[event & calm]),
                "foreseen_by_source": by_source,
                "predicted_over_base": float(cost.mean()) / base if base else float("nan"),
                "calibration_error": calibration_error(bins),
                "reliability": [row._asdict() for row in bins],
                "reward_r2": 1.0 - error / variance if variance else float("nan"),
                "reward_error": error,
                "reward_variance": variance,
                "ends_base": _mean(over),
                "ends_auprc": average_precision(over, ends),
                "ends_over_base": float(ends.mean()) / _mean(over) if over.any() else float("nan"),
            }
        )
    return rows


def judge_window(recording: Recording, seen: Forecast, alarm: Alarm) -> Row:
    """Judge the whole window, or the part of it until the episode ended: the sum of the costs, and
    whether there is any.

    The score of "any cost" is 1 - prod(1 - predicted cost) over the steps.
    """
    # -- costs [K, H], and what is said of the window [K]
    costs = recording.cost[seen.follow] * seen.within
    predicted = seen.cost.astype(np.float64) * seen.within
    event = costs.sum(1) > 0
    calm = recording.cost[seen.starts] == 0
    score = 1.0 - np.prod(1.0 - predicted, 1)
    alarmed = alarm.up(predicted)

    # -- over all starts, and over those that do not cost themselves
    table: Row = {
        "cost_correlation": _correlation(predicted.sum(1), costs.sum(1)),
        **alarm._asdict(),
    }
    for prefix, rows in (("", np.ones(len(event), bool)), ("onset_", calm)):
        table |= {
            f"{prefix}base": _mean(event[rows]),
            f"{prefix}auprc": average_precision(event[rows], score[rows]),
            f"{prefix}recall": recall_at(event[rows], score[rows], FALSE_ALARMS),
            f"{prefix}foreseen": _mean(alarmed[rows & event]),
            f"{prefix}false_alarms": _mean(alarmed[rows & ~event]),
        }
    table["persistence"] = average_precision(event, recording.cost[seen.starts])
    return table


@torch.inference_mode()
def judge_filter(
    model: SafetyWorldModel, recording: Recording, latents: Latents, images: int
) -> Row:
    """Judge the filtered state itself (k = 0): its cost, and how well it shows its own observation
    in `images` of the rows.
    """
    # Before the first decision nothing can cost.
    index = torch.from_numpy(np.flatnonzero(recording.first == 0))
    cost = torch.cat([model.cost(latents.at(part)) for part in index.split(CHUNK)]).numpy()
    event = recording.cost[index.numpy()] > 0
    base = _mean(event)
    return {
        "base": base,
        "auprc": average_precision(event, cost),
        "predicted_over_base": float(cost.mean()) / base if base else float("nan"),
        **decoding_errors(model, recording, latents, images),
    }


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _correlation(a: Floats, b: Floats) -> float:
    if len(a) < 2 or a.std() == 0 or b.std() == 0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])
