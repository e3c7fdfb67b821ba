"""The operating point of an assistant, by one rule for all assistants.

A point is an assistant at one value of its knob, beside the operators alone on the same worlds. The
points that help compete if they keep `LEAST_RETURN` of the best return among them. Of these the one
of least cost is chosen; of equal costs the one of least effective intervention rate, and of equal
rates the one that was named first. An assistant without a point that helps is silent: the commands
are executed as they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

LEAST_RETURN = 0.98
"""Share of the best return that a point has to keep."""
TOLERANCE = 0.02
"""Share of the operators' own mean up to which a mean over the same episodes counts as equal to it.
A return or a cost is better only beyond that; it is worse only beyond that and beyond the standard
error of the difference.
"""


@dataclass(frozen=True)
class Point:
    """Means over the episodes of one value, and of the operators alone over the same episodes."""

    value: float | None  # of the knob; None: the assistant has none
    episodes: int
    return_: float  # per episode
    cost: float  # env steps that cost, per episode
    effective: float  # share of the decisions at which a correction changed a force
    alone_return: float  # of the operators alone, per episode
    alone_cost: float  # of the operators alone, env steps that cost, per episode
    # standard errors of the mean differences to the operators alone, over the same episodes
    return_error: float = 0.0
    cost_error: float = 0.0


def helps(point: Point) -> bool:
    """Tell whether a point is of use: compared with the operators alone, it costs less at a return
    that is not lower, or returns more at a cost that is not higher.
    """
    gain = point.return_ - point.alone_return
    saving = point.alone_cost - point.cost
    least_gain = TOLERANCE * abs(point.alone_return)
    least_saving = TOLERANCE * abs(point.alone_cost)
    # What a standard error explains is no loss.
    most_loss = max(least_gain, point.return_error)
    most_excess = max(least_saving, point.cost_error)
    costs_less = saving > least_saving and gain >= -most_loss
    returns_more = gain > least_gain and saving >= -most_excess
    return costs_less or returns_more


def may_help(point: Point, spread_return: float, spread_cost: float) -> bool:
    """Tell whether more episodes could show that a point helps: whether it would help if both of
    its means were better by their standard error.

    Args:
        point: the point.
        spread_return: standard deviation of the return of an episode of the operators alone.
        spread_cost: the same of the cost.
    """
    root = math.sqrt(point.episodes)
    optimistic = replace(
        point,
        return_=point.return_ + spread_return / root,
        cost=point.cost - spread_cost / root,
        # The means are already better by an error.
        return_error=0.0,
        cost_error=0.0,
    )
    return helps(optimistic)


def ranked(points: Sequence[Point]) -> list[Point]:
    """Return points from the best to the worst by the rule (see the module); those that help come
    before all others. They have to be of the same episodes.
    """
    helping = [point for point in points if helps(point)]
    others = [point for point in points if not helps(point)]
    return _by_rule(helping) + _by_rule(others)


def chosen(points: Sequence[Point]) -> Point | None:
    """Return the operating point, or None where no point helps: the assistant is silent then."""
    helping = [point for point in points if helps(point)]
    if not helping:
        return None
    return _by_rule(helping)[0]


def contested(
    points: Sequence[Point], spread_return: float, spread_cost: float, most: int
) -> list[Point]:
    """Return the points on which further episodes are spent, in the order of the rule: at most
    `most` of those that may help. Spreads as in `may_help`.
    """
    order = ranked(points)
    return [point for point in order if may_help(point, spread_return, spread_cost)][:most]


def _by_rule(points: Sequence[Point]) -> list[Point]:
    """Return points from the best to the worst, whether they help or not."""
    left = list(points)
    order: list[Point] = []
    while left:
        best_return = max(point.return_ for point in left)
        floor = best_return - (1.0 - LEAST_RETURN) * abs(best_return)
        keeping = [point for point in left if point.return_ >= floor]
        best_point = min(keeping, key=_price)  # of equal ones the first
        order.append(best_point)
        left.remove(best_point)
    return order


def _price(point: Point) -> tuple[float, float]:
    """Return what decides between points that keep their return: the smaller, the better."""
    return point.cost, point.effective
