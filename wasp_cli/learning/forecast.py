"""Forecasts of a world model on recorded episodes: costs, rewards and ends, imagined from filtered
latents under the recorded actions. K starts, H imagined steps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.shards import Recording
from wasp_cli.models.world_model import SafetyWorldModel

CHUNK = 256  # starts that are imagined together
Floats = NDArray[Any]


class Followed(NamedTuple):
    """The recorded rows after K starts."""

    rows: NDArray[np.int64]  # [K, H]; after the end of an episode its last row
    within: NDArray[np.bool_]  # [K, H] the episode was still going


class Forecast(NamedTuple):
    """Imagined costs, rewards and ends, means over samples of the prior."""

    starts: NDArray[np.int64]  # [K] rows of the recording
    cost: Floats  # [K, H] probability of a cost at the arrived state
    reward: Floats  # [K, H]
    ends: Floats
    """[K, H] probability that the episode ends by its own rule in arriving there, given that it
    went on until then.
    """
    follow: NDArray[np.int64]  # [K, H] rows that really followed, as in `Followed`
    within: NDArray[np.bool_]  # [K, H] the episode was still going; only these steps are judged


def spread_starts(
    recording: Recording, horizon: int, count: int, *, ended: bool = False
) -> NDArray[np.int64]:
    """Choose starts: at most `count` rows [K], evenly spread over those from which `horizon` rows
    follow within their episode.

    With `ended`, rows whose episode ends sooner by its own rule may be chosen too: where a goal
    ends the episode, the other starts never see the goal. Episodes that a time limit cuts off are
    left out, because what would have followed is not known.
    """
    starts = recording.window_starts(horizon + 1)
    if ended:
        for end in np.flatnonzero(recording.terminal > 0).tolist():
            before = np.arange(max(0, end - horizon), end)
            same_episode = recording.episode[before] == recording.episode[end]
            starts = np.union1d(starts, before[same_episode])
    if len(starts) <= count:
        return starts
    places = np.linspace(0, len(starts) - 1, count).round().astype(int)
    chosen: NDArray[np.int64] = starts[places]
    return chosen


def what_followed(recording: Recording, starts: NDArray[np.int64], horizon: int) -> Followed:
    """Return the rows that followed each of K starts."""
    episodes = recording.episode[starts]
    last = np.searchsorted(recording.episode, episodes, side="right")[:, None] - 1  # [K, 1]
    ahead: NDArray[np.int64] = starts[:, None] + 1 + np.arange(horizon)
    within: NDArray[np.bool_] = ahead <= last
    return Followed(np.minimum(ahead, last), within)


@torch.inference_mode()
def forecast(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    starts: NDArray[np.int64],
    horizon: int,
    samples: int,
    seed: int,
) -> Forecast:
    """Imagine `horizon` steps from K starts under the recorded actions, several times each.

    Args:
        model: imagines.
        recording: N rows.
        latents: filtered latents of the N rows.
        starts: [K] rows.
        horizon: H.
        samples: imagined futures over which means are taken.
        seed: of all draws.
    """
    source = generator(seed)
    cost = torch.zeros(len(starts), horizon)
    reward = torch.zeros(len(starts), horizon)
    ends = torch.zeros(len(starts), horizon)
    followed = what_followed(recording, starts, horizon)
    for begin in range(0, len(starts), CHUNK):
        here = slice(begin, begin + CHUNK)
        index = torch.from_numpy(starts[here])
        actions = torch.from_numpy(recording.action[followed.rows[here]])
        for _ in range(samples):
            arrived = roll_prior(model, latents.at(index), actions, source)
            cost[here] += model.cost(arrived) / samples
            reward[here] += model.reward(arrived) / samples
            ends[here] += (1.0 - model.continues(arrived)) / samples
    return Forecast(
        starts, cost.numpy(), reward.numpy(), ends.numpy(), followed.rows, followed.within
    )
