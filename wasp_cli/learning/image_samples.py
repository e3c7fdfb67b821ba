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

from wasp_cli.learning.diagnostics import Forecast, imagined_observations
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import Recording
from wasp_cli.models.world_model import SafetyWorldModel

# imagined windows that reach a cost from a start without one, and windows without any cost
COSTLY, CALM = 3, 2
# frames that are decoded from the filtered state: images, and vectors, which are drawn as points
DECODED = 10
DECODED_VECTORS = 200
FILES = {"pixels": "images.parquet", "state": "vectors.parquet"}
"""By what a world model reads: the file of its samples."""

Frames = NDArray[Any]  # images uint8 [K, 6, 64, 64], or vectors float32 [K, S]


class Sample(NamedTuple):
    """K frames of the model beside the rows of the recording that they belong to."""

    rows: NDArray[np.int64]  # [K]
    frames: Frames  # decoded or imagined
    predicted: NDArray[Any]  # [K] probability of a cost


@torch.inference_mode()
def decoded_sample(model: SafetyWorldModel, recording: Recording, latents: Latents) -> Sample:
    """Decode filtered states: spread over the episodes, the second half of them costly ones where
    there are any.
    """
    count = DECODED if model.reads == "pixels" else DECODED_VECTORS
    spread = np.linspace(0, len(recording.first) - 1, count).astype(int)
    costly = np.flatnonzero(recording.cost > 0)
    if len(costly):
        spread[count // 2 :] = costly[
            np.linspace(0, len(costly) - 1, count - count // 2).astype(int)
        ]
    seen = latents.at(torch.from_numpy(spread))
    return Sample(spread, _stored(model.decode(seen).numpy(), model), model.cost(seen).numpy())


def sampled_windows(recording: Recording, seen: Forecast) -> list[int]:
    """Choose windows, as indices into the starts of the forecast.

    Onsets of a cost late in the window first, spread over the episodes, then windows without any
    cost.
    """
    whole: NDArray[np.bool_] = np.asarray(seen.within.all(1))
    costs = (recording.cost[seen.follow] > 0) & whole[:, None]
    calm = (recording.cost[seen.starts] == 0) & whole
    first = np.where(costs.any(1), costs.argmax(1), -1)
    # An onset in the middle of the window shows both the approach and the cost.
    onset = np.flatnonzero(calm & (first >= costs.shape[1] // 3) & (first < costs.shape[1] - 1))
    if not len(onset):
        onset = np.flatnonzero(costs.any(1))
    quiet = np.flatnonzero(calm & ~costs.any(1))
    return [
        int(i) for group, count in ((onset, COSTLY), (quiet, CALM)) for i in _spread(group, count)
    ]


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

    Predicted costs are those of the forecast (means over its samples), the first one is the
    filtered state's.
    """
    index, horizon = np.array(windows, int), seen.cost.shape[1]
    starts = seen.starts[index]
    now = latents.at(torch.from_numpy(starts))
    begun, cost = model.decode(now).numpy()[:, None], model.cost(now).numpy()[:, None]
    future = imagined_observations(model, recording, latents, starts, horizon, generator(seed))
    imagined = _stored(np.concatenate([begun, future], 1), model)
    predicted = np.concatenate([cost, seen.cost[index]], 1)
    return [
        Sample(np.arange(start, start + horizon + 1), imagined[i], predicted[i])
        for i, start in enumerate(starts.tolist())
    ]


def write_samples(
    path: Path, recording: Recording, decoded: Sample, imagined: Sequence[Sample]
) -> None:
    """Write a Parquet file with a row per frame.

    Columns: `window` (-1: decoded, then the imagined ones by number), `step` (place in it),
    `behaviour`, `episode`, `decision` (rows since the episode began), `cost` (the real one),
    `predicted` (its probability), `true` and `model` (the bytes of uint8 [6, 64, 64]; of vectors
    lists of S numbers in the task's own units).
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
    """K images as binary values, or K vectors as lists."""
    count = len(frames)
    size = int(np.prod(frames.shape[1:]))
    flat = np.ascontiguousarray(frames)
    if frames.dtype != np.uint8:
        return pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel(), pa.float32()), size)
    return pa.FixedSizeBinaryArray.from_buffers(pa.binary(size), count, [None, pa.py_buffer(flat)])


def _stored(frames: NDArray[Any], model: SafetyWorldModel) -> Frames:
    """Images from [0, 1] to uint8; vectors as they are."""
    if model.reads == "state":
        return frames.astype(np.float32)
    return (frames * 255).round().clip(0, 255).astype(np.uint8)


def _spread(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most `count` of the rows, from the middles of equal parts."""
    count = min(count, len(rows))
    spread: NDArray[np.int64] = rows[
        ((np.arange(count) + 0.5) / max(1, count) * len(rows)).astype(int)
    ]
    return spread
