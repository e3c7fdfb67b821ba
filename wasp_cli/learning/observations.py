"""How well a world model predicts what assistants see: images, in [0, 1], or vectors, in standard
deviations of the dataset. K starts, H imagined steps, S numbers of a vector.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.shards import Recording
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import SafetyWorldModel

CHUNK = 256  # observations that are decoded together
PART = 8  # starts whose imagined observations are in memory together, about

Floats = NDArray[Any]
Row = dict[str, Any]


def observed_as(recording: Recording) -> Literal["image", "vector"]:
    """Return the word for observations in the names of numbers about them."""
    return "image" if recording.reads == "pixels" else "vector"


@torch.inference_mode()
def decoding_errors(
    model: SafetyWorldModel, recording: Recording, latents: Latents, count: int
) -> Row:
    """Judge how well filtered latents show their own observations, in `count` rows.

    Returns:
        The mean squared error per pixel or component, and that of the mean observation, which is
        the variance.
    """
    rows = len(recording.first)
    chosen = np.linspace(0, rows - 1, min(count, rows)).round().astype(int)
    true = _comparable(model, recording, recording.seen[chosen])
    parts = [model.decode(latents.at(part)) for part in torch.from_numpy(chosen).split(CHUNK)]
    decoded = _comparable(model, recording, torch.cat(parts).numpy())
    # The mean of standardised vectors is 0.
    mean = model.mean_image.numpy() if recording.reads == "pixels" else np.zeros_like(true[0])
    word = observed_as(recording)
    return {
        f"{word}_error": float(((decoded - true) ** 2).mean()),
        f"{word}_variance": float(((mean - true) ** 2).mean()),
    }


@torch.inference_mode()
def imagined_observations(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    starts: NDArray[np.int64],
    horizon: int,
    source: torch.Generator,
) -> Floats:
    """Imagine the observations of one future per start, under the recorded actions.

    Returns:
        Images, float32 [K, H, 6, 64, 64] in [0, 1], or vectors [K, H, S] in the task's own units.
    """
    actions = torch.from_numpy(recording.action[starts[:, None] + 1 + np.arange(horizon)])
    arrived = roll_prior(model, latents.at(torch.from_numpy(starts)), actions, source)
    flat = Latent(arrived.h.flatten(0, 1), arrived.z.flatten(0, 1))
    parts = [model.decode(flat.rows(part)) for part in torch.arange(len(flat.h)).split(CHUNK)]
    imagined: Floats = torch.cat(parts).unflatten(0, (len(starts), horizon)).numpy()
    return imagined


@torch.inference_mode()
def judge_observations(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    starts: NDArray[np.int64],
    horizon: int,
    samples: int,
    seed: int,
) -> list[Row]:
    """Judge imagined images, or vectors, per imagined step from K starts.

    Returns:
        A row per step. `image_error` is the mean squared error per pixel of the imagined image
        (mean over samples), `copy_error` that of a copy of what was seen at the start,
        `image_over_copy` their ratio (below 1: better than a copy), and `image_explained` 1 minus
        the ratio. For vectors the names begin with `vector`.
    """
    source = generator(seed)
    model_error = np.zeros(horizon)
    copy_error = np.zeros(horizon)
    for part in np.array_split(starts, max(1, len(starts) // PART)):
        # -- imagined, true and first observations of some starts
        futures = [
            imagined_observations(model, recording, latents, part, horizon, source)
            for _ in range(samples)
        ]
        mean: Floats = np.asarray(sum(futures) / samples)
        imagined = _comparable(model, recording, mean)
        after = part[:, None] + 1 + np.arange(horizon)
        true = _comparable(model, recording, recording.seen[after])
        first = _comparable(model, recording, recording.seen[part])[:, None]

        # -- errors, mean over an observation and sum over the starts
        within = tuple(range(2, true.ndim))
        model_error += ((imagined - true) ** 2).mean(within).sum(0)
        copy_error += ((first - true) ** 2).mean(within).sum(0)

    count = max(1, len(starts))
    word = observed_as(recording)
    rows = []
    for error, of_copy in zip(
        (model_error / count).tolist(), (copy_error / count).tolist(), strict=True
    ):
        ratio = error / of_copy if of_copy else float("nan")
        rows.append(
            {
                f"{word}_error": error,
                "copy_error": of_copy,
                f"{word}_over_copy": ratio,
                f"{word}_explained": 1.0 - ratio,
            }
        )
    return rows


def _comparable(model: SafetyWorldModel, recording: Recording, values: Floats) -> Floats:
    """Convert observations [K, ...], seen or decoded, into the units in which errors are
    measured.
    """
    if recording.reads == "state":
        standardised: Floats = model.standardised(torch.from_numpy(values)).numpy()
        return standardised
    if values.dtype == np.uint8:
        return values.astype(np.float32) / 255.0
    return values
