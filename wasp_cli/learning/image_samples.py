"""Sample what a world model sees and imagines, as numbers: true frames beside decoded and
imagined ones. A frame is an image, or a vector where the task shows no image.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray

from wasp_cli.learning.forecast import Forecast
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.observations import imagined_observations
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import Recording
from wasp_cli.models.world_model import SafetyWorldModel

COSTLY = 3  # imagined windows that reach a cost from a start without one
CALM = 2  # imagined windows without any cost
DECODED = 10  # images that are decoded from the filtered state
DECODED_VECTORS = 200  # the same of vectors, which are drawn as points
FILES = {"pixels": "images.parquet", "state": "vectors.parquet"}
"""The file of the samples, by what a world model reads."""

Frames = NDArray[Any]  # images uint8 [K, 6, 64, 64], or vectors float32 [K, S]


class Sample(NamedTuple):
    """K frames of the model beside the rows of the recording that they belong to."""

    rows: NDArray[np.int64]  # [K]
    frames: Frames  # decoded or imagined
    predicted: NDArray[Any]  # [K] probability of a cost


@torch.inference_mode()
def decoded_sample(model: SafetyWorldModel, recording: Recording, latents: Latents) -> Sample:
    """Decode filtered states that are spread over the episodes. The second half of them are costly
    where there are costly ones.
    """
    count = DECODED if model.reads == "pixels" else DECODED_VECTORS
    rows = np.linspace(0, len(recording.first) - 1, count).astype(int)
    costly = np.flatnonzero(recording.cost > 0)
    if len(costly):
        half = count // 2
        places = np.linspace(0, len(costly) - 1, count - half).astype(int)
        rows[half:] = costly[places]
    latent = latents.at(torch.from_numpy(rows))
    frames = _stored(model.decode(latent).numpy(), model)
    return Sample(rows, frames, model.cost(latent).numpy())


def sampled_windows(recording: Recording, seen: Forecast) -> list[int]:
    """Choose windows to imagine: first some in which a cost begins, spread over the episodes, then
    some without any cost.

    Returns:
        Indices into the starts of the forecast.
    """
    # -- the first costly step of every window [K], -1 without one
    horizon = seen.within.shape[1]
    whole: NDArray[np.bool_] = np.asarray(seen.within.all(1))
    costs = (recording.cost[seen.follow] > 0) & whole[:, None]
    costly = costs.any(1)
    calm_start = (recording.cost[seen.starts] == 0) & whole
    first = np.where(costly, costs.argmax(1), -1)

    # -- an onset in the middle of the window shows both the approach and the cost
    onset = np.flatnonzero(calm_start & (first >= horizon // 3) & (first < horizon - 1))
    if not len(onset):
        onset = np.flatnonzero(costly)
    calm = np.flatnonzero(calm_start & ~costly)
    return [*_spread(onset, COSTLY).tolist(), *_spread(calm, CALM).tolist()]


@torch.inference_mode()
def imagined_samples(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    seen: Forecast,
    windows: Sequence[int],
    seed: int,
) -> list[Sample]:
    """Imagine the chosen windows once each: 1 + H frames, the first of which is the decoded
    filtered state.

    The predicted costs are those of the forecast, means over its samples; the first one is that of
    the filtered state.
    """
    index = np.array(windows, int)
    horizon = seen.cost.shape[1]
    starts = seen.starts[index]

    # -- the filtered state, and what is imagined from it
    latent = latents.at(torch.from_numpy(starts))
    decoded = model.decode(latent).numpy()[:, None]
    cost = model.cost(latent).numpy()[:, None]
    future = imagined_observations(model, recording, latents, starts, horizon, generator(seed))

    frames = _stored(np.concatenate([decoded, future], 1), model)
    predicted = np.concatenate([cost, seen.cost[index]], 1)
    return [
        Sample(np.arange(start, start + horizon + 1), frames[i], predicted[i])
        for i, start in enumerate(starts.tolist())
    ]


def write_samples(
    path: Path, recording: Recording, decoded: Sample, imagined: Sequence[Sample]
) -> None:
    """Write a Parquet file with a row per frame.

    Columns: `window` (-1 for decoded frames, otherwise the number of the imagined window), `step`
    (position in the window), `behaviour`, `episode`, `decision` (rows since the episode began),
    `cost` (the real one), `predicted` (its probability), `true` and `model` (images as the bytes of
    uint8 [6, 64, 64], vectors as lists of S numbers in the task's own units).
    """
    samples = [decoded, *imagined]
    rows = np.concatenate([sample.rows for sample in samples])
    sizes = [len(sample.rows) for sample in samples]
    decision = rows - np.searchsorted(recording.episode, recording.episode[rows])
    columns = {
        "window": pa.array(np.repeat(np.arange(-1, len(imagined)), sizes), pa.int16()),
        "step": pa.array(np.concatenate([np.arange(size) for size in sizes]), pa.int16()),
        "behaviour": pa.array(recording.behaviour[rows].tolist(), pa.string()),
        "episode": pa.array(recording.episode[rows], pa.int32()),
        "decision": pa.array(decision, pa.int32()),
        "cost": pa.array(recording.cost[rows], pa.float32()),
        "predicted": pa.array(
            np.concatenate([sample.predicted for sample in samples]), pa.float32()
        ),
        "true": _column(recording.seen[rows]),
        "model": _column(np.concatenate([sample.frames for sample in samples])),
    }
    pq.write_table(
        pa.table(columns),
        path,
        compression="zstd",
        compression_level=3,
        use_dictionary=["behaviour"],
    )


def _column(frames: Frames) -> pa.Array:
    """Return K images as binary values, or K vectors as lists."""
    count = len(frames)
    size = int(np.prod(frames.shape[1:]))
    flat = np.ascontiguousarray(frames)
    if frames.dtype != np.uint8:
        return pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel(), pa.float32()), size)
    return pa.FixedSizeBinaryArray.from_buffers(pa.binary(size), count, [None, pa.py_buffer(flat)])


def _stored(frames: NDArray[Any], model: SafetyWorldModel) -> Frames:
    """Return images in [0, 1] as uint8, and vectors as float32."""
    if model.reads == "state":
        return frames.astype(np.float32)
    return (frames * 255).round().clip(0, 255).astype(np.uint8)


def _spread(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return at most `count` of the rows: the middles of equal parts."""
    count = min(count, len(rows))
    middles = (np.arange(count) + 0.5) / max(1, count) * len(rows)
    spread: NDArray[np.int64] = rows[middles.astype(int)]
    return spread
