"""The severity at which an operator is impaired by a stated amount.

The amount is the share that the operator keeps of the way from the return of random commands to
that of the unimpaired expert, over the same worlds: 1 is as good as the expert, 0 no better than
random. It is no ratio of returns, which may lie below zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

AUTO = "auto"
"""What a spec writes in the place of a severity's number where one is to be chosen."""
FILE = "severity.json"
"""What the stage `severity` leaves; its `severity` is the number that was chosen."""


@dataclass(frozen=True)
class Choice:
    """A severity, and whether the share that was asked for lies between two known ones."""

    severity: float
    within: bool


def share_kept(returned: float, random: float, expert: float) -> float:
    """Return which share of the way from `random` to `expert` a return keeps; NaN where the expert
    returns no more than random commands, so that there is no way.
    """
    way = expert - random
    if not way > 0.0:
        return math.nan
    return (returned - random) / way


def choose(severities: Sequence[float], shares: Sequence[float], kept: float) -> Choice:
    """Return the severity at which a share falls to `kept`.

    On the line between the first two neighbours of which the milder keeps at least `kept`, and the
    worse at most that. Where all keep more, the worst one; where the mildest keeps less, that one.

    Args:
        severities: from the mildest to the worst, at least one.
        shares: what an operator keeps at each of them.
    """
    if shares[0] < kept:
        return Choice(severities[0], within=False)
    known = list(zip(severities, shares, strict=True))
    for (milder, above), (worse, below) in pairwise(known):
        if below <= kept:
            passed = (above - kept) / (above - below) if above > below else 0.0
            return Choice(milder + passed * (worse - milder), within=True)
    return Choice(severities[-1], within=shares[-1] == kept)


def nearest(severities: Sequence[float], shares: Sequence[float], kept: float) -> Choice:
    """Return, of severities with none between them, that of the two neighbours of `choose` which
    keeps the share that is nearer to `kept`; of equally near ones the milder.
    """
    places = [float(number) for number in range(len(severities))]
    found = choose(places, shares, kept)
    around = (math.floor(found.severity), math.ceil(found.severity))
    place = min(around, key=lambda number: abs(shares[number] - kept))
    return Choice(severities[place], found.within)
