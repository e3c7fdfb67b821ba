"""Intervals against all that a bootstrap does, step by step; contrasts against all their
resamples, and the t interval against SciPy.
"""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tests.report.made import one_cell, renamed, singles
from wasp_cli.cells.table import WEIGHT_OF, CellTable, condition
from wasp_cli.report import bootstrap
from wasp_cli.report.bootstrap import (
    RESAMPLES,
    Estimate,
    contrast_of,
    difference_of,
    drawn,
    improvement_over,
    iqm_of,
    mean_of,
    t_limits,
)
from wasp_cli.report.summary import summarise
from wasp_cli.store.tables import CellIdentity

RNG = np.random.default_rng(3)


def cell(
    seed: int, value: float, method: str = "ida", worlds: Sequence[float] = (1, 2), **columns: Any
) -> CellTable:
    """A table of one cell."""
    return one_cell(CellIdentity("goal1", method, "full", "noisy", value, seed), worlds, **columns)


def joined(cells: Sequence[CellTable]) -> CellTable:
    return CellTable.joined(cells)


def made(
    seeds: Sequence[int],
    method: str = "ida",
    values: Sequence[float] = (0.2, 0.4, 0.6),
    worlds: int = 7,
) -> list[CellTable]:
    """Cells with random episodes of several lengths, some of which intervene nowhere."""
    found = []
    for seed in seeds:
        for value in values:
            decisions = RNG.integers(5, 50, worlds)
            intervened = np.minimum(
                decisions, RNG.integers(0, 3, worlds) * RNG.integers(0, 20, worlds)
            )
            columns: dict[str, Any] = {
                "decisions": decisions,
                "intervened": intervened,
                "cost": RNG.integers(0, 9, worlds) + 10 * value,
            }
            columns |= {"return": RNG.normal(seed, 1, worlds), "int_rate": intervened / decisions}
            columns["mag_int"] = np.where(intervened > 0, RNG.random(worlds), np.nan)
            found.append(cell(seed, value, method, 1000 * seed + np.arange(worlds), **columns))
    return found


def limits(numbers: Sequence[float]) -> list[float]:
    return list(
        np.percentile([number for number in numbers if not math.isnan(number)], [2.5, 97.5])
    )


def interval(estimate: Estimate | None) -> list[float]:
    return [estimate.interval.low, estimate.interval.high]


def ratio(cell: CellTable, key: str, times: dict[float, float]) -> float:
    """The pooled column with every episode as often as its world was drawn, step by step."""
    total = mass = 0.0
    weight = WEIGHT_OF[key]
    for e, world in enumerate(cell.worlds):
        value = cell.episodes(key)[e]
        if not math.isnan(value):
            share = times[world] * (1.0 if weight is None else cell.episodes(weight)[e])
            total, mass = total + share * value, mass + share
    return total / mass if mass else math.nan


def mean(numbers: Sequence[float]) -> float:
    defined = [number for number in numbers if not math.isnan(number)]
    return sum(defined) / len(defined) if defined else math.nan


def middle_mean(numbers: Sequence[float]) -> float:
    """The integral over the quantiles from 1/4 to 3/4: every number four times, and a quarter
    of that list cut off on either side.
    """
    defined = sorted(number for number in numbers if not math.isnan(number))
    each = [number for number in defined for _ in range(4)]
    return mean(each[len(defined) : 3 * len(defined)])


def better(
    one: CellTable, two: CellTable, key: str, times: dict[float, float] | None = None
) -> float:
    won = pairs = 0.0
    for x, here in zip(one.episodes(key), one.worlds, strict=True):
        for y, there in zip(two.episodes(key), two.worlds, strict=True):
            if not math.isnan(x - y):
                many = 1.0 if times is None else times[here] * times[there]
                won, pairs = won + many * ((x > y) + 0.5 * (x == y)), pairs + many
    return won / pairs if pairs else math.nan


def world_draws(cells: Sequence[CellTable]) -> list[dict[float, float]]:
    worlds = sorted({world for cell in cells for world in cell.worlds})
    return [dict(zip(worlds, counts, strict=True)) for counts in drawn(len(worlds))]


def seed_draws(cells: Sequence[CellTable]) -> list[list[int]]:
    seeds = sorted({int(cell.seeds[0]) for cell in cells})
    return [
        [seed for seed, times in zip(seeds, counts, strict=True) for _ in range(int(times))]
        for counts in drawn(len(seeds))
    ]


@pytest.mark.parametrize("clusters", [1, 2, 3, 30])
def test_draws(clusters: int) -> None:
    counts = drawn(clusters)
    assert counts.shape == (RESAMPLES, clusters)
    assert (counts.sum(1) == clusters).all()
    assert counts.mean(0) == pytest.approx(np.ones(clusters), abs=0.1)  # none is preferred


def test_draws_are_the_same_everywhere() -> None:
    assert drawn(3)[:4].tolist() == [[3, 0, 0], [3, 0, 0], [0, 2, 1], [1, 0, 2]]


@pytest.mark.parametrize("key", ["return", "int_rate", "mag_int"])
def test_one_seed_resamples_worlds(key: str) -> None:
    own, other = made([4]), made([4], "human")
    draws = world_draws(own)
    every = [[ratio(cell, key, times) for cell in own] for times in draws]
    assert interval(mean_of(joined(own), key)) == pytest.approx(
        limits([mean(numbers) for numbers in every])
    )
    assert interval(iqm_of(joined(own), key)) == pytest.approx(
        limits([middle_mean(numbers) for numbers in every])
    )
    changes = [
        mean([ratio(x, key, times) - ratio(y, key, times) for x, y in zip(own, other, strict=True)])
        for times in draws
    ]
    assert interval(difference_of(joined(own), joined(other), key)) == pytest.approx(
        limits(changes)
    )
    found = mean_of(joined(own), key)
    assert (found.interval.unit, found.interval.clusters) == ("world", 7)


@pytest.mark.parametrize("key", ["return", "int_rate", "mag_int"])
def test_several_seeds_resample_seeds(key: str) -> None:
    own, other = made([0, 1, 5]), made([0, 1, 5], "human", (0.4, 0.6, 0.8))  # the conditions differ
    means = {
        seed: mean([cell.pooled(key)[0] for cell in own if cell.seeds[0] == seed])
        for seed in (0, 1, 5)
    }
    draws = seed_draws(own)
    assert interval(mean_of(joined(own), key)) == pytest.approx(
        limits([mean([means[seed] for seed in draw]) for draw in draws])
    )
    middle = [
        middle_mean([cell.pooled(key)[0] for seed in draw for cell in own if cell.seeds[0] == seed])
        for draw in draws
    ]
    assert interval(iqm_of(joined(own), key)) == pytest.approx(limits(middle))
    pairs = [(x, y) for x in own for y in other if condition(x.cells[0]) == condition(y.cells[0])]
    assert len(pairs) == 6
    changes = {
        seed: mean([x.pooled(key)[0] - y.pooled(key)[0] for x, y in pairs if x.seeds[0] == seed])
        for seed in (0, 1, 5)
    }
    assert interval(difference_of(joined(own), joined(other), key)) == pytest.approx(
        limits([mean([changes[seed] for seed in draw]) for draw in draws])
    )
    wins = {
        seed: mean([better(x, y, key) for x, y in pairs if x.seeds[0] == seed])
        for seed in (0, 1, 5)
    }
    found = improvement_over(joined(own), joined(other), key, "up")
    assert interval(found) == pytest.approx(
        limits([mean([wins[seed] for seed in draw]) for draw in draws])
    )
    assert found.value == pytest.approx(mean(list(wins.values())))
    assert (found.interval.unit, found.interval.clusters) == ("training", 3)


def test_seeds_that_share_a_training_are_resampled_by_world() -> None:
    own, other = (
        [renamed(each, lambda _: {"training_seed": 0}) for each in made([4, 5], method)]
        for method in ("ida", "human")
    )
    draws = world_draws(own)

    def means(numbers: Callable[[int, dict[float, float]], float]) -> list[float]:
        return [
            mean([mean([numbers(i, times) for i in part]) for part in (range(3), range(3, 6))])
            for times in draws
        ]

    found = mean_of(joined(own[:4]), "return")
    assert interval(mean_of(joined(own), "return")) == pytest.approx(
        limits(means(lambda i, times: ratio(own[i], "return", times)))
    )
    changes = means(
        lambda i, times: ratio(own[i], "return", times) - ratio(other[i], "return", times)
    )
    assert interval(difference_of(joined(own), joined(other), "return")) == pytest.approx(
        limits(changes)
    )
    assert found.interval.words == "95 % interval over 14 worlds"
    assert found.interval.low < found.value < found.interval.high


@pytest.mark.parametrize("many", [4, 8, 12])
def test_interquartile_mean_is_a_trimmed_one(many: int) -> None:
    numbers = RNG.normal(size=many)
    found = iqm_of(
        joined(
            [cell(0, i / many, **{"return": [number, number]}) for i, number in enumerate(numbers)]
        ),
        "return",
    )
    assert found.value == pytest.approx(stats.trim_mean(numbers, 0.25))


@pytest.mark.parametrize(
    ("numbers", "wanted"),
    [([5.0], 5.0), ([1.0, 2.0], 1.5), ([0.0, 1.0, 9.0], 13 / 6), ([0, 1, 2, 3, 99], 2.0)],
)
def test_interquartile_mean_in_part(numbers: list[float], wanted: float) -> None:
    found = iqm_of(
        joined(
            [cell(0, i / 9, **{"return": [number, number]}) for i, number in enumerate(numbers)]
        ),
        "return",
    )
    assert found.value == pytest.approx(wanted)


def test_ties_count_half_and_direction_matters() -> None:
    own, other = cell(0, 0.2, cost=[1, 2]), cell(0, 0.2, "human", cost=[2, 2])
    up, down = (improvement_over(own, other, "cost", way) for way in ("up", "down"))
    assert (up.value, down.value) == (0.25, 0.75)


def test_nothing_to_say() -> None:
    lonely, other = cell(0, 0.2, worlds=[1], cost=[3]), cell(0, 0.4, "human", cost=[1, 2])
    assert mean_of(lonely, "cost") == Estimate(3.0, None)  # one cluster
    assert mean_of(lonely, "uir") is None  # not a column of this cell
    assert mean_of(cell(0, 0.2, cost=[math.nan, math.nan]), "cost") is None
    assert iqm_of(joined([]), "cost") is None
    assert difference_of(lonely, other, "cost") is None  # no common condition
    assert improvement_over(lonely, other, "cost", "down") is None


LEFT, RIGHT = [[1.0, 4.0], [10.0, 30.0]], [[8.0, 6.0], [40.0, 90.0]]


def cells(costs: list[list[float]], method: str) -> CellTable:
    return joined(
        [
            cell(seed, 0.2, method, np.arange(len(each)) + 9.0, cost=each)
            for seed, each in enumerate(costs)
        ]
    )


def test_the_resamples_are_those_of_two_levels() -> None:
    """Two trainings of two worlds have 64 resamples: 2 x 2 trainings, and 4 choices of worlds
    for each of the two places.
    """
    margin = -0.25
    by_training = [
        [np.mean([a[i] - 0.75 * b[i] for i in pick]) for pick in product((0, 1), repeat=2)]
        for a, b in zip(LEFT, RIGHT, strict=True)
    ]
    every = sorted(
        np.mean(pair)
        for s, t in product((0, 1), repeat=2)
        for pair in product(by_training[s], by_training[t])
    )
    own, other = cells(LEFT, "ida"), cells(RIGHT, "human")
    found = bootstrap._resampled(
        [
            bootstrap._Training(*pair, "cost", margin)
            for pair in zip(singles(own), singles(other), strict=True)
        ]
    )
    assert set(np.round(found, 9)) == set(np.round(every, 9))
    for number in set(np.round(every, 9)):
        share = np.mean(np.round(every, 9) == number)
        assert np.mean(np.round(found, 9) == number) == pytest.approx(
            share, abs=4 * np.sqrt(share * (1 - share) / len(found))
        )
    contrast = contrast_of(own, other, "cost", margin)
    assert contrast.trainings == pytest.approx([2.5 - 5.25, 20 - 48.75])
    assert contrast_of(own.choose([1, 0]), other.choose([1, 0]), "cost", margin) == contrast


def test_t_intervals_are_those_of_the_t_distribution() -> None:
    assert t_limits([3.0]) is None
    # the quantile with one degree of freedom from a table: 12.706
    assert t_limits([-1.0, 1.0]) == pytest.approx((-12.7062, 12.7062), abs=1e-4)
    assert t_limits([1.0, 2.0, 6.0]) == pytest.approx(
        stats.t.interval(0.95, 2, 3.0, stats.sem([1.0, 2.0, 6.0]))
    )


def covered(
    trainings: int, between: float, times: int = 400, worlds: int = 12
) -> tuple[float, float]:
    """How often both intervals have the true contrast in them: -3, with normal spreads of
    trainings, worlds and what pairing leaves.
    """
    draws, truth, found = np.random.default_rng(5), -3.0, np.zeros(2)
    for _ in range(times):
        shift = truth + between * draws.normal(size=trainings)
        right = [(40 + 5 * draws.normal(size=worlds)).tolist() for _ in range(trainings)]
        left = [
            (np.array(costs) + by + 2 * draws.normal(size=worlds)).tolist()
            for costs, by in zip(right, shift, strict=True)
        ]
        contrast = contrast_of(cells(left, "ida"), cells(right, "human"), "cost")
        for i, limits in enumerate((contrast.bootstrap, contrast.t)):
            found[i] += limits is not None and limits[0] <= truth <= limits[1]
    return float(found[0] / times), float(found[1] / times)


@pytest.mark.parametrize(
    ("trainings", "between", "hierarchical"), [(1, 0.0, (0.87, 0.96)), (3, 2.0, (0.70, 0.90))]
)
def test_coverage(trainings: int, between: float, hierarchical: tuple[float, float]) -> None:
    """Nominal 95 %. Three trainings that differ are covered too seldom, which is why the t
    interval, which is right, stands beside.
    """
    bootstrap, t = covered(trainings, between)
    assert hierarchical[0] <= bootstrap <= hierarchical[1], (bootstrap, t)
    assert 0.92 <= t <= 0.98 if trainings > 1 else t == 0, (bootstrap, t)


def test_seeds_that_share_a_training_are_one_training_with_all_their_worlds() -> None:
    own, other = cells(LEFT, "ida"), cells(RIGHT, "human")
    # a world belongs to one seed
    worlds = {"world": np.array([0.0, 1.0, 10.0, 11.0])}
    shared = [
        renamed(side.with_columns(worlds), lambda _: {"training_seed": 0}) for side in (own, other)
    ]
    contrast = contrast_of(*shared, "cost", -0.25)
    whole = contrast_of(
        cells([sum(LEFT, [])], "ida"),  # noqa: RUF017
        cells([sum(RIGHT, [])], "human"),  # noqa: RUF017
        "cost",
        -0.25,
    )
    assert contrast == whole
    assert (len(contrast.trainings), contrast.t) == (1, None)
    assert contrast.bootstrap is not None


def test_a_bound_is_taken_off() -> None:
    own = cells(LEFT, "ida")
    against, zero = contrast_of(own, 2.5, "cost"), contrast_of(own, 0.0, "cost")
    assert against.trainings == pytest.approx([0.0, 17.5])
    assert against.bootstrap == pytest.approx(np.array(zero.bootstrap) - 2.5)
    assert contrast_of(own, 2.5, "uir") is None


@pytest.mark.parametrize("key", ["cost", "int_rate"])
def test_a_difference_is_over_the_worlds_that_both_sides_have(key: str) -> None:
    (whole,) = made([1], values=(0.2,), worlds=9)
    part = cell(
        1,
        0.2,
        "wasp",
        whole.worlds[2:5],
        **{name: whole.episodes(name)[2:5] for name in whole.names if name != "world"},
    )
    other = cell(1, 0.2, "wasp", [7.0], **{key: [1.0], "decisions": [3.0]})
    for left, right in ((part, whole), (whole, part)):
        difference, contrast = difference_of(left, right, key), contrast_of(left, right, key)
        assert difference is not None
        assert contrast is not None
        assert (difference.value, contrast.value) == (0.0, 0.0)
        assert interval(difference) == [0.0, 0.0]
    assert difference_of(other, whole, key) is None
    assert contrast_of(other, whole, key) is None


def test_trainings_with_cells_under_other_conditions_show_no_spread() -> None:
    whole = joined(made([1]) + made([2]))
    uneven = whole.choose(range(len(whole) - 1))
    assert interval(mean_of(whole, "cost"))
    assert summarise(whole, "cost").sd is not None
    for estimate in (
        mean_of(uneven, "cost"),
        iqm_of(uneven, "cost"),
        difference_of(uneven, joined(made([1, 2], "human")), "cost"),
    ):
        assert estimate is not None
        assert estimate.interval is None
    assert summarise(uneven, "cost").sd is None
