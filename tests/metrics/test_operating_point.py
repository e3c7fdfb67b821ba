"""The rule of operating points, against a second reading of it and by its properties."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.metrics.operating_point import (
    LEAST_RETURN,
    TOLERANCE,
    Point,
    chosen,
    contested,
    helps,
    may_help,
    ranked,
)

ALONE = {"alone_return": 10.0, "alone_cost": 5.0}


def point(return_: float, cost: float, effective: float = 0.5, **alone: float) -> Point:
    return Point(1.0, 4, return_, cost, effective, **{**ALONE, **alone})


@pytest.mark.parametrize(
    ("return_", "cost", "expected"),
    [
        (20.0, 5.8, True),  # twice the return; whether the cost is higher cannot be told
        (20.0, 6.2, False),  # twice the return, for a cost that is higher
        (9.2, 2.0, True),  # less than half of the cost; whether the return is lower cannot be told
        (8.8, 2.0, False),  # less than half of the cost, for a return that is lower
        (9.9, 4.95, False),  # neither is better by more than the tolerance
    ],
)
def test_what_a_standard_error_explains_is_no_loss(return_, cost, expected):
    assert helps(replace(point(return_, cost), return_error=1.0, cost_error=1.0)) is expected


numbers = st.floats(-50, 50).map(lambda number: round(number, 1))
costs = st.floats(0, 50).map(lambda number: round(number, 1))
POINTS = st.lists(
    st.builds(
        Point,
        value=st.floats(0, 4),
        episodes=st.just(4),
        return_=numbers,
        cost=costs,
        effective=st.floats(0, 1),
        alone_return=st.just(10.0),
        alone_cost=st.just(5.0),
    ),
    min_size=1,
    max_size=7,
)


@pytest.mark.parametrize(
    ("return_", "cost", "expected"),
    [
        (10.0, 4.0, True),  # the same return for less cost
        (11.0, 5.0, True),  # more return for the same cost
        (9.81, 4.0, True),  # a return that is lower by less than the tolerance
        (10.0, 5.0, False),  # what the operators do anyway
        (10.1, 4.95, False),  # both better by less than the tolerance
        (9.7, 0.0, False),  # no cost at all, for a lower return
        (20.0, 5.2, False),  # twice the return, for a higher cost
    ],
)
def test_a_point_helps_if_one_mean_is_better_and_the_other_no_worse(return_, cost, expected):
    assert helps(point(return_, cost)) is expected


def test_where_the_operators_cost_nothing_no_cost_is_no_higher():
    free = {"alone_cost": 0.0}
    assert helps(point(11.0, 0.0, **free))
    assert not helps(point(11.0, 0.1, **free))


@given(POINTS)
def test_the_choice_is_what_reading_the_rule_aloud_gives(points):
    useful = []
    for each in points:
        same = TOLERANCE * each.alone_return, TOLERANCE * each.alone_cost
        cheaper = each.cost < each.alone_cost - same[1]
        richer = each.return_ > each.alone_return + same[0]
        poorer = each.return_ < each.alone_return - same[0]
        dearer = each.cost > each.alone_cost + same[1]
        if (cheaper and not poorer) or (richer and not dearer):
            useful.append(each)
    found = chosen(points)
    if not useful:
        assert found is None
        return
    best = max(each.return_ for each in useful)
    keeping = [
        each for each in useful if each.return_ >= best - (1 - LEAST_RETURN) * abs(best) - 1e-9
    ]
    assert found in keeping
    assert found.cost == min(each.cost for each in keeping)
    assert found.effective == min(each.effective for each in keeping if each.cost == found.cost)


@given(POINTS)
def test_points_that_do_harm_change_no_choice(points):
    helping = [each for each in points if helps(each)]
    assert chosen(points) == chosen(helping)


@given(POINTS)
def test_the_ranking_has_every_point_once_and_begins_with_the_choice(points):
    order = ranked(points)
    assert sorted(map(repr, order)) == sorted(map(repr, points))
    if (first := chosen(points)) is not None:
        assert order[0] == first
    useful = [helps(each) for each in order]
    assert useful == sorted(useful, reverse=True)


@given(POINTS, costs, costs)
def test_who_helps_may_help_and_more_noise_excludes_nobody(points, spread, more):
    for each in points:
        if helps(each):
            assert may_help(each, spread, spread)
        if may_help(each, spread, spread):
            assert may_help(each, spread + more, spread + more)


def test_of_equal_costs_the_point_that_acts_less_is_chosen():
    acts, rests = point(12.0, 1.0, effective=0.7), point(11.9, 1.0, effective=0.2)
    assert chosen([acts, rests]) == rests
    assert chosen([acts, replace(rests, cost=1.1)]) == acts


def test_only_what_may_still_help_is_contested():
    clear, close, lost = point(12.0, 3.0), point(9.0, 3.0), point(2.0, 3.0)
    assert contested([lost, close, clear], 3.0, 1.0, 3) == [clear, close]
    assert contested([lost, close, clear], 3.0, 1.0, 1) == [clear]
    assert contested([lost], 3.0, 1.0, 1) == []
