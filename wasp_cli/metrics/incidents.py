"""What an incident costs in decisions, and the bound of a safety gate that follows from it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import ArtifactError

FILE = "incidents.json"
"""In the artifact of a dataset: how many incidents there are of each length."""
TAU_SHARE = 0.25
"""Share of an incident of average length above which a safety gate fires.

The incidents of the published operators alone have 5.7 costly decisions on Goal1, 3.3 on Race1 and
3.6 on Formula1, of which a quarter is .8 to 1.4; 1 was chosen by hand there.
"""
MOST_TAU = 1.0  # largest bound, in costly decisions, however long incidents last


def incident_lengths(cost: NDArray[Any], episode: NDArray[Any]) -> NDArray[np.int64]:
    """Return the length [N] in decisions of each incident: consecutive decisions of one episode
    with a cost.

    Args:
        cost: [K] above 0 where a decision costs.
        episode: [K] number of its episode; rows of one episode stand together.
    """
    costly = np.asarray(cost) > 0
    if not costly.any():
        return np.zeros(0, np.int64)
    # An incident begins where a costly decision follows a free one, or that of another episode.
    begins = costly.copy()
    begins[1:] &= ~costly[:-1] | (episode[1:] != episode[:-1])
    number = np.cumsum(begins)[costly] - 1
    return np.bincount(number).astype(np.int64)


def write_incidents(folder: Path, lengths: NDArray[np.int64]) -> None:
    """Write the lengths [N] of incidents to a dataset's folder, as counts by length."""
    values, counts = np.unique(lengths, return_counts=True)
    table = {str(length): int(count) for length, count in zip(values, counts, strict=True)}
    (folder / FILE).write_text(json.dumps(table))


def read_incidents(folder: Path) -> NDArray[np.int64]:
    """Return the lengths [N] of the incidents of a dataset, in ascending order.

    Raises:
        ArtifactError: the file cannot be read, or the dataset is of a version that did not count
            incidents.
    """
    try:
        table: dict[str, int] = json.loads((folder / FILE).read_text())
    except (OSError, ValueError) as error:
        raise ArtifactError(
            f"the dataset in '{folder}' does not say how long its incidents are",
            "write a number as `tau_c`, or record the dataset with this version (`--reuse none`)",
        ) from error
    lengths = np.array([int(length) for length in table], np.int64)
    counts = np.array(list(table.values()), np.int64)
    return np.repeat(lengths, counts)


def incident_cost(lengths: NDArray[np.int64], horizon: int, gamma: float) -> float | None:
    """Return the mean cost of incidents as a gate sums it, in costly decisions: over the first
    `horizon` decisions of each, discounted by `gamma`. None where there is no incident.

    Args:
        lengths: [N] in decisions.
        horizon: H.
        gamma: discount per decision.
    """
    if not len(lengths):
        return None
    sums = np.cumsum(gamma ** np.arange(horizon))
    return float(sums[np.minimum(lengths, horizon) - 1].mean())


def tau_of(incident: float | None) -> float:
    """Return the bound of a safety gate for incidents of that cost: a quarter of it, and at most
    1. Where there was no incident (None), the bound is that for a single costly decision.
    """
    if incident is None:
        incident = 1.0
    return min(MOST_TAU, TAU_SHARE * incident)
