"""The rule of `wasp severities`, against numbers worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from wasp_cli.errors import NotAccepted
from wasp_cli.report.tables.severity_check import (
    Difference,
    SeverityCheck,
    SeverityLevel,
    difference,
    judge,
    number,
    require_accepted,
    verdict_lines,
)

EXPERT = [10.0, 14.0, 12.0, 12.0]
"""Mean 12: the moderate severity may keep 9."""
ANYTHING = (-50.0,) * 4


def level(severity: str | None, value: float | None, *seeds: Sequence[float], absent: int = 0) -> SeverityLevel:
    """One list of returns for each seed."""
    return SeverityLevel(severity, value, {(s, e): number for s, own in enumerate(seeds) for e, number in enumerate(own)}, absent=absent)


def check(*levels: SeverityLevel, expert: Sequence[float] = EXPERT) -> SeverityCheck:
    return SeverityCheck("goal1", "laggy", level(None, None, expert), levels)


def mild(*seeds: Sequence[float]) -> SeverityLevel:
    return level("mild", 0.5, *seeds)


def moderate(*seeds: Sequence[float]) -> SeverityLevel:
    return level("moderate", 0.7, *seeds)


def severe(*seeds: Sequence[float]) -> SeverityLevel:
    return level("severe", 0.85, *seeds)


def said(found: SeverityCheck) -> str:
    return str(judge(found))


KEEPS = "of the expert's return"
CASES = (
    # Means 10, 8 and 3; 8 of 12 is 66.7 %.
    ((mild([8, 12, 10, 10]), moderate([6, 10, 8, 8]), severe([1, 5, 3, 3])), f"accepted: falls at every step; moderate keeps 67 % {KEEPS}"),
    # Differences 4, -3, 2, -2: mean 0.25, SD sqrt(32.75 / 3) = 3.304, SE 1.652.
    (
        (mild([4, 9, 4, 8]), moderate([8, 6, 6, 6]), severe([1, 1, 1, 1])),
        "undecided: from mild 0.5 to moderate 0.7 it rises by 0.2 +- 1.7, which may be chance: more episodes or seeds",
    ),
    # Differences 1, 2, 2, 1: mean 1.5, SD sqrt(1 / 3) = 0.577, SE 0.289.
    (
        (mild([4, 5, 4, 5]), moderate([5, 7, 6, 6]), severe([1, 1, 1, 1])),
        "not accepted: rises from 4.5 (mild 0.5) to 6.0 (moderate 0.7), 1.5 +- 0.3: rescale it in the spec",
    ),
    ((mild([4, 9, 4, 8]), moderate([4, 9, 4, 8])), "not accepted: stays at 6.2 from mild 0.5 to moderate 0.7: rescale it in the spec"),
    # Less 0.75 x expert: 2.5, 1.5, 2, 2: mean 2, SD sqrt(0.5 / 3) = 0.408, SE 0.204. 11 of 12 is 91.7 %.
    (
        (mild([11, 13, 12, 12]), moderate([10, 12, 11, 11]), severe([1, 1, 1, 1])),
        f"not accepted: moderate keeps 92 % {KEEPS}, 2.0 +- 0.2 above 75 % of it: rescale it in the spec",
    ),
    # Less 0.75 x expert: 5, -4, 1, -1: mean 0.25, SD sqrt(42.75 / 3) = 3.775, SE 1.887. 9.25 of 12 is 77.1 %.
    (
        (moderate([12.5, 6.5, 10, 8]),),
        f"undecided: moderate keeps 77 % {KEEPS}, 0.2 +- 1.9 above 75 % of it, which may be chance: more episodes or seeds",
    ),
    # Three quarters exactly are a loss of a quarter.
    ((moderate([7.5, 10.5, 9, 9]),), f"accepted: only one severity; trend not tested; moderate keeps 75 % {KEEPS}"),
    # Every failure is named, once with what to do.
    (
        (mild([10, 12, 11, 11]), moderate([11, 13, 12, 12]), severe([12, 14, 13.5, 12.5])),
        "not accepted: rises from 11.0 (mild 0.5) to 12.0 (moderate 0.7), 1.0 +- 0.0; rises from 12.0 (moderate 0.7) to 13.0 "
        f"(severe 0.85), 1.0 +- 0.2; moderate keeps 100 % {KEEPS}, 3.0 +- 0.2 above 75 % of it: rescale it in the spec",
    ),
    # What is sure hides what is undecided.
    (
        (mild([4, 9, 4, 8]), moderate([8, 6, 6, 6]), severe([9, 7, 7, 7])),
        "not accepted: rises from 6.5 (moderate 0.7) to 7.5 (severe 0.85), 1.0 +- 0.0: rescale it in the spec",
    ),
)


@pytest.mark.parametrize(("levels", "text"), CASES)
def test_the_rule_in_words(levels: Sequence[SeverityLevel], text: str) -> None:
    found = check(*levels)
    assert verdict_lines([found]) == [f"goal1 laggy: {text}"]
    if not text.startswith("not accepted"):
        require_accepted([found])
        return
    with pytest.raises(NotAccepted, match=r"1 of 2 operators is not accepted: goal1 laggy$") as caught:
        require_accepted([found, check(moderate([1, 1, 1, 1]))])
    assert (caught.value.exit_code, caught.value.hint) == (1, "change its severities in the spec, and say so there")


def test_two_standard_errors_are_the_limit() -> None:
    def rising(*rises: float) -> SeverityCheck:
        return check(mild([0, 0, 0, 0]), moderate(ANYTHING), severe(np.add(ANYTHING, rises).tolist()))

    # Of 1 and 3 the mean is 2 and the SE 1; the middle severity falls.
    assert said(SeverityCheck("goal1", "laggy", level(None, None, [9, 9]), (mild([0, 0]), moderate([1, 3])))).startswith(
        "not accepted: rises from 0 "
    )
    assert judge(rising(1, 1, -0.5, -0.5)).outcome == "undecided"
    assert judge(rising(1, 1, 0.5, 0.5)).outcome == "not accepted"


def test_the_first_step_is_compared_with_the_expert_and_is_not_part_of_the_rule() -> None:
    found = check(mild([20, 20, 20, 20]), moderate([6, 10, 8, 8]))
    first, second = found.changes()
    assert (first.mean, second.mean) == (8.0, -12.0)
    assert judge(found).outcome == "accepted"


def test_without_the_name_the_middle_one_is_held_against_the_expert() -> None:
    low, half, high = level("low", 0.1, [9, 9, 9, 9]), level("half", 0.5, [6, 6, 6, 6]), level("high", 0.9, [1, 1, 1, 1])
    assert said(check(low, half, high)) == "accepted: falls at every step; half keeps 50 % of the expert's return"
    assert said(check(half)) == "accepted: only one severity; trend not tested; half keeps 50 % of the expert's return"
    both = check(low, half)
    assert both.moderate is None
    reason = "none of 2 severities is named moderate, and none is in the middle"
    assert said(both) == f"accepted: falls at every step; how much it loses is not judged: {reason}"
    assert check(low, moderate([2, 2, 2, 2])).moderate is not None  # the name counts, wherever it stands


@pytest.mark.parametrize(("expert", "shown"), [([-2.0, -1, -1, -1], "-1.2"), ([1.0, -1, 0, 0], "0")])
def test_a_share_of_a_return_that_is_not_positive_is_undefined(expert: list[float], shown: str) -> None:
    found = check(mild([-9, -9, -9, -9]), moderate([-20, -20, -20, -20]), expert=expert)
    text = f"undecided: the expert's return is {shown}, so that no share of it is defined: train the expert longer"
    assert (said(found), found.share(found.levels[0])) == (text, None)
    rising = check(mild([-20, -20, -20, -20]), moderate([-9, -9, -9, -9]), expert=expert)
    assert said(rising).startswith("not accepted: rises from -20.0 (mild 0.5) to -9.0 (moderate 0.7)")


def test_missing_cells_leave_the_verdict_open() -> None:
    whole, partial = mild([20, 20, 20, 20]), level("moderate", 0.7, [1, 1, 1, 1], absent=2)
    assert said(check(whole, partial)) == "incomplete: 2 of its cells, or of the expert's, are missing"
    nothing = SeverityCheck("goal1", "laggy", level(None, None, absent=1), (whole, moderate([30, 30, 30, 30])))
    assert said(nothing) == "incomplete: 1 of its cells, or of the expert's, is missing"
    assert nothing.changes()[0] is None
    assert math.isnan(nothing.expert.mean)
    require_accepted([nothing])


def test_one_episode_cannot_decide_against_an_operator() -> None:
    found = SeverityCheck("goal1", "laggy", level(None, None, [10]), (mild([4]), moderate([9])))
    text = (
        "undecided: from mild 0.5 to moderate 0.7 it rises by 5.0 in the only episode, which may be chance; "
        "moderate keeps 90 % of the expert's return, 1.5 in the only episode above 75 % of it, which may be chance: more episodes or seeds"
    )
    assert said(found) == text


def test_three_seeds_are_paired_by_seed_and_episode() -> None:
    worlds = [[0.0, 100.0], [200.0, 300.0], [400.0, 500.0]]  # far apart: unpaired, nothing could be told of them
    lower = mild(*worlds)
    higher = moderate(*([value + rise for value, rise in zip(own, (1, 2), strict=True)] for own in worlds))
    change = difference(higher.returns, lower.returns)
    # 1 and 2, three times each: mean 1.5, SD sqrt(1.5 / 5).
    assert (change.mean, change.pairs) == (1.5, 6)
    assert change.se == pytest.approx(math.sqrt(0.3 / 6))
    assert judge(SeverityCheck("goal1", "laggy", level(None, None, *worlds), (lower, higher))).outcome == "not accepted"


def test_only_common_episodes_are_compared() -> None:
    one, other = {(0, 0): 5.0, (0, 1): 7.0, (1, 0): 99.0}, {(0, 1): 1.0, (0, 0): 1.0, (2, 0): -99.0}
    found = difference(one, other)
    assert (found.mean, found.se, found.pairs) == (5.0, pytest.approx(1.0), 2)
    assert difference(one, {(3, 0): 1.0}) is None


def test_the_standard_error_is_that_of_numpy() -> None:
    random = np.random.default_rng(0)
    worlds = random.normal(10, 5, (3, 40))
    expert, own = worlds + random.normal(2, 1, (3, 40)), worlds + random.normal(0, 1, (3, 40))
    found = difference(level("a", 1, *own).returns, level("b", 1, *expert).returns, 0.75)
    values = (own - 0.75 * expert).ravel()
    assert found.mean == pytest.approx(values.mean())
    assert found.se == pytest.approx(values.std(ddof=1) / np.sqrt(120))
    # It is the spread of the mean over new draws of the same kind.
    means = [(random.normal(10, 5, 120) * 0.25 + random.normal(-1.5, 1.25, 120)).mean() for _ in range(2000)]
    assert found.se == pytest.approx(np.std(means), rel=0.2)


def test_a_difference_has_the_digits_of_its_standard_error() -> None:
    shown = [str(Difference(mean, se, 9)) for mean, se in ((1.62, 0.51), (1.62, 1.4), (0.123, 0.04), (-2.0, 0.0), (0.01234, 0.0031))]
    assert shown == ["1.6 +- 0.5", "1.6 +- 1.4", "0.12 +- 0.04", "-2.0 +- 0.0", "0.012 +- 0.003"]
    assert str(Difference(0.25, None, 1)) == "0.25 in the only episode"


def test_numbers_have_the_digits_that_say_something() -> None:
    assert [number(value) for value in (12.345, -1.25, 0.256, 0.2, 0.0, -0.0312)] == ["12.3", "-1.2", "0.26", "0.2", "0", "-0.031"]
