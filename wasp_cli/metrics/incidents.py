"""What an incident costs in decisions, and the bound of a safety gate that follows from it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

TAU_SHARE = 0.25
"""Share of an incident of average length above which a safety gate fires.

The incidents of the published operators alone have 5.7 costly decisions on Goal1, 3.3 on Race1 and
3.6 on Formula1, of which a quarter is .8 to 1.4; 1 was chosen by hand there.
"""
MOST_TAU = 1.0  # however long incidents last: one costly decision is as much as should be expected


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
    begins = costly.copy()
    begins[1:] &= ~costly[:-1] | (episode[1:] != episode[:-1])
    number = np.cumsum(begins)[costly] - 1
    return np.bincount(number).astype(np.int64)


def incident_cost(
    cost: NDArray[Any], episode: NDArray[Any], horizon: int, gamma: float
) -> float | None:
    """Return the mean cost of an incident as a gate sums it: its first `horizon` decisions,
    discounted by `gamma` each; None where nothing cost.
    """
    lengths = incident_lengths(cost, episode)
    if not len(lengths):
        return None
    sums = np.cumsum(gamma ** np.arange(horizon))
    return float(sums[np.minimum(lengths, horizon) - 1].mean())


def tau_of(incident: float | None) -> float:
    """Return the bound of a safety gate for incidents of that cost: a quarter of it, and at most
    1. Where nothing is known of incidents, the bound is that for a single decision.
    """
    return min(MOST_TAU, TAU_SHARE * (1.0 if incident is None else incident))
