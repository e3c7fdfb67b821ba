"""The statistics of a dataset of LeRobot: minimum, maximum, mean, standard deviation, number and
five quantiles of every feature, by episode and of all episodes together.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Stats = dict[str, NDArray[Any]]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
BYTE = 256


def number_stats(values: NDArray[Any]) -> Stats | None:
    """Return the statistics of numbers [T, ...] over T, [...] each, at least of one dimension;
    None where one of the numbers is undefined.
    """
    rows = np.asarray(values, np.float64)
    if rows.ndim == 1:
        rows = rows[:, None]
    if not np.isfinite(rows).all():
        return None
    stats: Stats = {
        "min": rows.min(0),
        "max": rows.max(0),
        "mean": rows.mean(0),
        "std": rows.std(0),
        "count": np.array([len(rows)]),
    }
    for name, share in QUANTILES.items():
        stats[name] = np.quantile(rows, share, axis=0)
    return stats


def image_stats(images: NDArray[np.uint8]) -> Stats:
    """Return the statistics of images uint8 [T, H, W, 3] by channel, in [0, 1] and of the shape
    [3, 1, 1], as LeRobot has them.
    """
    levels = np.arange(BYTE) / 255.0
    counts = np.stack(
        [np.bincount(images[..., channel].ravel(), minlength=BYTE) for channel in range(3)]
    )
    pixels = counts.sum(1)
    mean = (counts * levels).sum(1) / pixels
    present = counts > 0
    below = np.cumsum(counts, axis=1)
    stats: Stats = {
        "min": levels[present.argmax(1)],
        "max": levels[BYTE - 1 - present[:, ::-1].argmax(1)],
        "mean": mean,
        "std": np.sqrt((counts * (levels - mean[:, None]) ** 2).sum(1) / pixels),
    }
    for name, share in QUANTILES.items():
        stats[name] = levels[(below >= share * pixels[:, None]).argmax(1)]
    shaped = {name: values.reshape(3, 1, 1) for name, values in stats.items()}
    return {**shaped, "count": np.array([len(images)])}


def joined(before: Stats | None, new: Stats) -> Stats:
    """Return the statistics of two sets of episodes together.

    As LeRobot has it, a quantile of several episodes is the mean of theirs, by their lengths.
    """
    if before is None:
        return new
    first = before["count"]
    second = new["count"]
    count = first + second
    means = (before["mean"] * first + new["mean"] * second) / count
    spread = before["std"] ** 2 + (before["mean"] - means) ** 2
    other = new["std"] ** 2 + (new["mean"] - means) ** 2
    together: Stats = {
        "min": np.minimum(before["min"], new["min"]),
        "max": np.maximum(before["max"], new["max"]),
        "mean": means,
        "std": np.sqrt((spread * first + other * second) / count),
        "count": count,
    }
    for name in QUANTILES:
        together[name] = (before[name] * first + new[name] * second) / count
    return together


def as_json(stats: Mapping[str, Stats]) -> dict[str, dict[str, Any]]:
    """Return the statistics of all features as lists of numbers."""
    return {
        feature: {name: values.tolist() for name, values in numbers.items()}
        for feature, numbers in stats.items()
    }
