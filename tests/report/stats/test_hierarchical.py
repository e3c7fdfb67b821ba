"""The hierarchical bootstrap against all its resamples, and the t interval against SciPy."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from tests.report.stats.test_bootstrap import cell
from wasp_cli.report.stats.bootstrap import _resampled, _t_quantile, _Training, contrast_of, t_limits

LEFT, RIGHT = [[1.0, 4.0], [10.0, 30.0]], [[8.0, 6.0], [40.0, 90.0]]


def cells(costs: list[list[float]], method: str) -> list:  # type: ignore[type-arg]
    return [cell(seed, 0.2, method, np.arange(len(each)) + 9.0, cost=each) for seed, each in enumerate(costs)]


def test_the_resamples_are_those_of_two_levels() -> None:
    """Two trainings of two worlds have 64 resamples: 2 x 2 trainings, and 4 choices of worlds for each of the two places."""
    margin = -0.25
    by_training = [
        [np.mean([a[i] - 0.75 * b[i] for i in pick]) for pick in product((0, 1), repeat=2)] for a, b in zip(LEFT, RIGHT, strict=True)
    ]
    every = sorted(np.mean(pair) for s, t in product((0, 1), repeat=2) for pair in product(by_training[s], by_training[t]))
    own, other = cells(LEFT, "ida"), cells(RIGHT, "human")
    found = _resampled([_Training([pair], "cost", margin) for pair in zip(own, other, strict=True)])
    assert set(np.round(found, 9)) == set(np.round(every, 9))
    for number in set(np.round(every, 9)):
        share = np.mean(np.round(every, 9) == number)
        assert np.mean(np.round(found, 9) == number) == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / len(found)))
    contrast = contrast_of(own, other, "cost", margin)
    assert contrast is not None
    assert contrast.trainings == pytest.approx([2.5 - 5.25, 20 - 48.75])
    assert contrast_of(own[::-1], other[::-1], "cost", margin) == contrast


def test_t() -> None:
    for freedom in range(1, 31):
        assert _t_quantile(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-9)
    assert t_limits([3.0]) is None
    assert t_limits([1.0, 2.0, 6.0]) == pytest.approx(stats.t.interval(0.95, 2, 3.0, stats.sem([1.0, 2.0, 6.0])))


def covered(trainings: int, between: float, times: int = 400, worlds: int = 12) -> tuple[float, float]:
    """How often both intervals have the true contrast in them: -3, with normal spreads of trainings, worlds and what pairing leaves."""
    draws, truth, found = np.random.default_rng(5), -3.0, np.zeros(2)
    for _ in range(times):
        shift = truth + between * draws.normal(size=trainings)
        right = [(40 + 5 * draws.normal(size=worlds)).tolist() for _ in range(trainings)]
        left = [(np.array(costs) + by + 2 * draws.normal(size=worlds)).tolist() for costs, by in zip(right, shift, strict=True)]
        contrast = contrast_of(cells(left, "ida"), cells(right, "human"), "cost")
        assert contrast is not None
        for i, limits in enumerate((contrast.bootstrap, contrast.t)):
            found[i] += limits is not None and limits[0] <= truth <= limits[1]
    return float(found[0] / times), float(found[1] / times)


@pytest.mark.parametrize(
    ("trainings", "between", "hierarchical"),
    [(1, 0.0, (0.87, 0.96)), (3, 2.0, (0.70, 0.90)), (3, 0.0, (0.93, 1.0))],
)
def test_coverage(trainings: int, between: float, hierarchical: tuple[float, float]) -> None:
    """Nominal 95 %. Three trainings that differ are covered too seldom, which is why the t interval, which is right, stands beside."""
    bootstrap, t = covered(trainings, between)
    assert hierarchical[0] <= bootstrap <= hierarchical[1], (bootstrap, t)
    assert 0.92 <= t <= 0.98 if trainings > 1 else t == 0, (bootstrap, t)


def test_seeds_that_share_a_training_are_one_training_with_all_their_worlds() -> None:
    own, other = cells(LEFT, "ida"), cells(RIGHT, "human")
    shared = [[replace(one, chain_seed=0) for one in side] for side in (own, other)]
    for seed, side in product((0, 1), shared):  # a world belongs to one seed
        side[seed] = replace(side[seed], episodes={**side[seed].episodes, "world": np.arange(2) + 10.0 * seed})
    contrast = contrast_of(*shared, "cost", -0.25)
    whole = contrast_of(cells([sum(LEFT, [])], "ida"), cells([sum(RIGHT, [])], "human"), "cost", -0.25)  # noqa: RUF017
    assert contrast == whole
    assert contrast is not None
    assert (len(contrast.trainings), contrast.t) == (1, None)
    assert contrast.bootstrap is not None


def test_a_bound_is_taken_off() -> None:
    own = cells(LEFT, "ida")
    against, zero = contrast_of(own, 2.5, "cost"), contrast_of(own, 0.0, "cost")
    assert against is not None
    assert zero is not None
    assert against.trainings == pytest.approx([0.0, 17.5])
    assert against.bootstrap == pytest.approx(np.array(zero.bootstrap) - 2.5)
    assert contrast_of(own, 2.5, "uir") is None
