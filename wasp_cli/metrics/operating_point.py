"""The operating point of an assistant: one rule for all of them, and when none of its points helps.

A point is an assistant at one value of its knob, beside the operators alone on the same worlds. Of
the points that help, those count that keep `LEAST_RETURN` of the best return among them; of these
the one of least cost is chosen, of equal costs the one of least effective intervention rate, and of
equal rates the one that was named first. An assistant without a point that helps is silent: the
commands are executed as they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

LEAST_RETURN = 0.98
"""Share of the best return that a point has to keep."""
TOLERANCE = 0.02
"""What counts as equal to the operators alone: a difference of means over the same episodes up to
this share of the operators' own mean, or up to its own standard error where that is more. A return
or a cost is lower or higher beyond it."""


@dataclass(frozen=True)
class Point:
    """Means over the episodes of one value, and of the operators alone over the same episodes."""

    value: float | None  # of the knob; None: the assistant has none
    episodes: int
    return_: float  # per episode
    cost: float  # env steps that cost, per episode
    effective: float  # share of the decisions at which a correction changed a force
    alone_return: float
    alone_cost: float
    # standard errors of the mean differences to the operators alone, over the same episodes
    return_error: float = 0.0
    cost_error: float = 0.0


def helps(point: Point) -> bool:
    """Tell whether a point is of use: it costs less at a return that is not lower than that of the
    operators alone, or returns more at a cost that is not higher.
    """
    gain = point.return_ - point.alone_return
    saving = point.alone_cost - point.cost
    least_gain = max(TOLERANCE * abs(point.alone_return), point.return_error)
    least_saving = max(TOLERANCE * abs(point.alone_cost), point.cost_error)
    costs_less = saving > least_saving and gain >= -least_gain
    returns_more = gain > least_gain and saving >= -least_saving
    return costs_less or returns_more


def may_help(point: Point, spread_return: float, spread_cost: float) -> bool:
    """Tell whether more episodes could show that a point helps: it would if both of its means were
    better by their standard error.

    Args:
        spread_return: standard deviation of the return of an episode of the operators alone.
        spread_cost: the same of the cost.
    """
    root = math.sqrt(point.episodes)
    lucky = replace(
        point,
        return_=point.return_ + spread_return / root,
        cost=point.cost - spread_cost / root,
        # this is the error that they are better by
        return_error=0.0,
        cost_error=0.0,
    )
    return helps(lucky)


def ranked(points: Sequence[Point]) -> list[Point]:
    """Return points from the best to the worst by the rule (see the module): those that help stand
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
    """Return the points on which further episodes are spent, in the order of the rule: those that
    may help, `most` at most.
    """
    order = ranked(points)
    return [point for point in order if may_help(point, spread_return, spread_cost)][:most]


def _by_rule(points: Sequence[Point]) -> list[Point]:
    left = list(points)
    order: list[Point] = []
    while left:
        best = max(point.return_ for point in left)
        floor = best - (1.0 - LEAST_RETURN) * abs(best)
        keeping = [point for point in left if point.return_ >= floor]
        first = min(keeping, key=_price)  # of equal ones the first
        order.append(first)
        left.remove(first)
    return order


def _price(point: Point) -> tuple[float, float]:
    return point.cost, point.effective
