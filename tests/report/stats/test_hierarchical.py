"""The hierarchical bootstrap against all its resamples, and the t interval against SciPy."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import stats

from tests.report.stats.test_bootstrap import cell
from wasp_cli.report.stats.hierarchical import _resampled, _t_quantile, _Training, contrast_of, t_limits

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
