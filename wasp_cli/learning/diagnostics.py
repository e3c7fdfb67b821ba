"""What imagined costs, rewards and observations are worth on recorded episodes, per imagined step k
= 1..H and over the whole window.

From the filtered latent of a recorded row under the true actions: step k is held against what
arrived k rows later. What is observed are images, in [0, 1], or vectors, in standard deviations of
the dataset. K starts, S sources.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.dataset import Behaviour, Commander, record
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.shards import Recording
from wasp_cli.metrics.ranking import average_precision, average_precision_interval, recall_at
from wasp_cli.metrics.reliability import calibration_error, reliability
from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask

FALSE_ALARMS = 0.1  # share of the moments without a cost at which a recall is read
CHUNK = 256  # starts that are imagined, or observations that are decoded, together

# index of the first checkpoint that is not among the two `early` ones of the mixture
HALF_TRAINED = 2

Floats = NDArray[Any]
Row = dict[str, Any]


class Forecast(NamedTuple):
    """Imagined costs, rewards and ends, means over samples of the prior."""

    starts: NDArray[np.int64]  # [K] rows of the recording
    cost: Floats  # [K, H] probability of a cost at the arrived state
    reward: Floats  # [K, H]
    # [K, H] probability that the episode ends by its own rule in arriving there, given that it went
    # on until then
    ends: Floats
    # [K, H] rows that really followed; after the end of an episode its last one
    follow: NDArray[np.int64]
    within: NDArray[np.bool_]  # [K, H] the episode was still going; only these steps are judged


class Alarm(NamedTuple):
    """The rule of the safety gate, on imagined costs: Eq. 9 on Eq. 8 without a bootstrap."""

    threshold: float  # tau_c
    gamma: float  # gamma_c

    def up(self, cost: Floats) -> NDArray[np.bool_]:
        """Return where the alarm [K] is raised by costs [K, H]."""
        raised: NDArray[np.bool_] = (cost * self.gamma ** np.arange(cost.shape[1])).sum(
            1
        ) > self.threshold
        return raised


def spread_starts(
    recording: Recording, horizon: int, count: int, *, ended: bool = False
) -> NDArray[np.int64]:
    """Choose at most `count` rows [K], evenly spread over those from which `horizon` rows follow
    within their episode.

    With `ended`, also over those whose episode ends sooner by its own rule: where a goal ends it,
    the others never see the goal. Episodes that a time limit cuts off say nothing of what would
    have followed.
    """
    starts = recording.window_starts(horizon + 1)
    if ended:
        for end in np.flatnonzero(recording.terminal > 0).tolist():
            near = np.arange(max(0, end - horizon), end)
            starts = np.union1d(starts, near[recording.episode[near] == recording.episode[end]])
    if len(starts) <= count:
        return starts
    chosen: NDArray[np.int64] = starts[np.linspace(0, len(starts) - 1, count).round().astype(int)]
    return chosen


def what_followed(
    recording: Recording, starts: NDArray[np.int64], horizon: int
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the rows [K, H] after each start, after the end of its episode the last one again,
    and whether the episode was still going.
    """
    # [K, 1]
    last = np.searchsorted(recording.episode, recording.episode[starts], side="right")[:, None] - 1
    ahead: NDArray[np.int64] = starts[:, None] + 1 + np.arange(horizon)
    within: NDArray[np.bool_] = ahead <= last
    return np.minimum(ahead, last), within


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
    """Imagine from `starts` [K] under the true actions."""
    source = generator(seed)
    cost, reward, ends = (torch.zeros(len(starts), horizon) for _ in range(3))
    follow, within = what_followed(recording, starts, horizon)
    for begin in range(0, len(starts), CHUNK):
        here = slice(begin, begin + CHUNK)
        index = torch.from_numpy(starts[here])
        actions = torch.from_numpy(recording.action[follow[here]])
        for _ in range(samples):
            arrived = roll_prior(model, latents.at(index), actions, source)
            cost[here] += model.cost(arrived) / samples
            reward[here] += model.reward(arrived) / samples
            ends[here] += (1.0 - model.continues(arrived)) / samples
    return Forecast(starts, cost.numpy(), reward.numpy(), ends.numpy(), follow, within)


def judged_steps(
    recording: Recording, seen: Forecast, alarm: Alarm, sources: Sequence[str]
) -> list[Row]:
    """Judge every imagined step: a row of numbers for each.

    `base` is the share of costly steps and `auprc` that of c-hat, `auprc_low` and `auprc_high` a 95
    % interval of it over resampled episodes; `persistence` is that of "cost stays what it is at the
    start". `recall` is read at FALSE_ALARMS. `foreseen` is the share of the costs before which the
    alarm was up over the imagined window. With `onset_` only starts count that do not cost
    themselves. `reliability` has a row per bin. `ends_` is about episodes that end by the task's
    own rule.

    Args:
        recording: the recorded episodes.
        seen: what was imagined on them.
        alarm: raised before a cost, it makes the cost foreseen.
        sources: names of the cost sources.
    """
    raised = alarm.up(seen.cost * seen.within)
    rows = []
    for k, (going, *columns) in enumerate(
        zip(seen.within.T, seen.follow.T, seen.cost.T, seen.reward.T, seen.ends.T, strict=True), 1
    ):
        follow, cost, reward, ends = (column[going] for column in columns)
        now, up = recording.cost[seen.starts[going]], raised[going]
        calm = now == 0
        event, true_reward = recording.cost[follow] > 0, recording.reward[follow]
        base, bins = _mean(event), reliability(event, cost)
        over = recording.terminal[follow] > 0
        low, high = average_precision_interval(event, cost, recording.episode[seen.starts[going]])
        error, variance = float(((reward - true_reward) ** 2).mean()), float(true_reward.var())
        by = {kind: recording.sources[follow, i] > 0 for i, kind in enumerate(sources)}
        rows.append(
            {
                "k": k,
                "base": base,
                "auprc": average_precision(event, cost),
                "auprc_low": low,
                "auprc_high": high,
                "persistence": average_precision(event, now),
                "onset_base": _mean(event[calm]),
                "onset_auprc": average_precision(event[calm], cost[calm]),
                "recall": recall_at(event, cost, FALSE_ALARMS),
                "onset_recall": recall_at(event[calm], cost[calm], FALSE_ALARMS),
                "foreseen": _mean(up[event]),
                "onset_foreseen": _mean(up[event & calm]),
                "foreseen_by_source": {kind: _mean(up[costs]) for kind, costs in by.items()},
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


def judged_window(recording: Recording, seen: Forecast, alarm: Alarm) -> Row:
    """Judge the whole window, or what the episode left of it: the sum of costs, and whether there
    is any.

    The score of "any" is 1 - prod(1 - c-hat) over the steps.
    """
    # [K, H]
    costs, predicted = (
        recording.cost[seen.follow] * seen.within,
        seen.cost.astype(np.float64) * seen.within,
    )
    event, calm = costs.sum(1) > 0, recording.cost[seen.starts] == 0
    score, up = 1.0 - np.prod(1.0 - predicted, 1), alarm.up(predicted)
    table: Row = {
        "cost_correlation": _correlation(predicted.sum(1), costs.sum(1)),
        **alarm._asdict(),
    }
    for prefix, rows in (("", np.ones(len(event), bool)), ("onset_", calm)):
        table |= {
            f"{prefix}base": _mean(event[rows]),
            f"{prefix}auprc": average_precision(event[rows], score[rows]),
            f"{prefix}recall": recall_at(event[rows], score[rows], FALSE_ALARMS),
            f"{prefix}foreseen": _mean(up[rows & event]),
            f"{prefix}false_alarms": _mean(up[rows & ~event]),
        }
    return table | {"persistence": average_precision(event, recording.cost[seen.starts])}


@torch.inference_mode()
def judged_filter(
    model: SafetyWorldModel, recording: Recording, latents: Latents, images: int
) -> Row:
    """Judge the filtered state itself (k = 0): its cost, and how well it shows its own observation
    in `images` of the rows.
    """
    # nothing can cost before the first decision
    index = torch.from_numpy(np.flatnonzero(recording.first == 0))
    cost = torch.cat([model.cost(latents.at(part)) for part in index.split(CHUNK)]).numpy()
    event = recording.cost[index.numpy()] > 0
    base = _mean(event)
    chosen = (
        np.linspace(0, len(recording.first) - 1, min(images, len(recording.first)))
        .round()
        .astype(int)
    )
    true = _compared(model, recording, recording.seen[chosen])
    parts = [model.decode(latents.at(part)) for part in torch.from_numpy(chosen).split(CHUNK)]
    decoded = _compared(model, recording, torch.cat(parts).numpy())
    # A standardised vector of the dataset has the mean 0.
    mean = model.mean_image.numpy() if recording.reads == "pixels" else np.zeros_like(true[0])
    what = observed_as(recording)
    return {
        "base": base,
        "auprc": average_precision(event, cost),
        "predicted_over_base": float(cost.mean()) / base if base else float("nan"),
        f"{what}_error": float(((decoded - true) ** 2).mean()),
        f"{what}_variance": float(((mean - true) ** 2).mean()),
    }


def observed_as(recording: Recording) -> Literal["image", "vector"]:
    """Return what numbers about the observations of a recording are called."""
    return "image" if recording.reads == "pixels" else "vector"


def _compared(model: SafetyWorldModel, recording: Recording, values: Floats) -> Floats:
    """What was seen or decoded, [K, ...], in the units in which errors are measured."""
    if recording.reads == "state":
        standardised: Floats = model.standardised(torch.from_numpy(values)).numpy()
        return standardised
    return values.astype(np.float32) / 255.0 if values.dtype == np.uint8 else values


@torch.inference_mode()
def imagined_observations(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    starts: NDArray[np.int64],
    horizon: int,
    source: torch.Generator,
) -> Floats:
    """Imagine observations of one future per start: images, float32 [K, H, 6, 64, 64] in [0, 1],
    or vectors [K, H, S] in the task's own units.
    """
    actions = torch.from_numpy(recording.action[starts[:, None] + 1 + np.arange(horizon)])
    arrived = roll_prior(model, latents.at(torch.from_numpy(starts)), actions, source)
    flat = type(arrived)(arrived.h.flatten(0, 1), arrived.z.flatten(0, 1))
    parts = [model.decode(flat.rows(part)) for part in torch.arange(len(flat.h)).split(CHUNK)]
    imagined: Floats = torch.cat(parts).unflatten(0, (len(starts), horizon)).numpy()
    return imagined


@torch.inference_mode()
def judged_observations(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    starts: NDArray[np.int64],
    horizon: int,
    samples: int,
    seed: int,
) -> list[Row]:
    """Judge images, or vectors, per imagined step from starts [K].

    Squared error per pixel or component of what was imagined (mean over samples) and of a copy of
    what was seen at the start;

    `image_over_copy` is their ratio (below 1: better than a copy), `image_explained` the share of
    the change that is explained. Of vectors the names begin with `vector`.
    """
    what = observed_as(recording)
    source, error, copy = generator(seed), np.zeros(horizon), np.zeros(horizon)
    for part in np.array_split(starts, max(1, len(starts) // 8)):
        futures = [
            imagined_observations(model, recording, latents, part, horizon, source)
            for _ in range(samples)
        ]
        mean: Floats = np.asarray(sum(futures) / samples)
        imagined = _compared(model, recording, mean)
        after = part[:, None] + 1 + np.arange(horizon)
        true = _compared(model, recording, recording.seen[after])
        last = _compared(model, recording, recording.seen[part])[:, None]
        within = tuple(range(2, true.ndim))
        error += ((imagined - true) ** 2).mean(within).sum(0)
        copy += ((last - true) ** 2).mean(within).sum(0)
    count = max(1, len(starts))
    rows = []
    for mine, theirs in zip((error / count).tolist(), (copy / count).tolist(), strict=True):
        ratio = mine / theirs if theirs else float("nan")
        rows.append(
            {
                f"{what}_error": mine,
                "copy_error": theirs,
                f"{what}_over_copy": ratio,
                f"{what}_explained": 1.0 - ratio,
            }
        )
    return rows


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _correlation(a: Floats, b: Floats) -> float:
    if len(a) < 2 or a.std() == 0 or b.std() == 0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])


def unseen_behaviours(skills: int) -> list[Behaviour]:
    """List the kinds of operators; a half-trained one only where there is a checkpoint between
    the early ones and the last.
    """
    kinds = [
        Behaviour("sticky noise", sticky=1.0),
        Behaviour("delay with noise", delay=4, gaussian=0.25),
        Behaviour("drift", drift=0.5),
        Behaviour("half trained", skill=HALF_TRAINED),
        Behaviour("drift", drift=-0.5),
    ]
    return [kind for kind in kinds if kind.skill < 0 or kind.skill < skills - 1]


def unseen_episodes(
    task: VectorTask, skills: Sequence[PrivilegedPolicy], task_name: str, seed: int
) -> Recording:
    """Record one episode per row of the task, with seeds that no other stage uses.

    Args:
        task: with what assistants see and privileged observations.
        skills: the checkpoints, the expert last.
    """
    kinds = unseen_behaviours(len(skills))
    rows = [kinds[i % len(kinds)] for i in range(task.batch)]
    commander = Commander(
        skills,
        rows,
        task.action_size,
        np.random.default_rng(derive("diagnostics-commands", task_name, seed)),
    )
    seeds = [derive("diagnostics-episode", task_name, seed, i) for i in range(task.batch)]
    return record(task, seeds, commander.command, [kind.name for kind in rows], 0)
