"""Predicted gains beside realised ones, against plain readings of the definitions."""

import numpy as np
import pytest
from numpy.typing import NDArray

from wasp_cli.metrics.gains import (
    CLUSTERS,
    discounted,
    flatness,
    gain_bins,
    holds_from,
    mean_interval,
)

Column = NDArray[np.float64]
WORLDS, RESAMPLES = 12, 200


def invented(slope: float, offset: float, rows: int = 150) -> tuple[Column, Column, Column]:
    """Predicted and realised gains in WORLDS worlds, with ties among the predicted ones."""
    random = np.random.default_rng(7)
    predicted = random.exponential(1.0, rows).round(2)
    realised = slope * predicted + offset + random.normal(0.0, 0.6, rows)
    return predicted, realised, random.integers(0, WORLDS, rows).astype(np.float64)


def resampled(cluster: Column) -> list[NDArray[np.int64]]:
    """The rows of every resample, one after the other."""
    names = np.unique(cluster)
    share = np.full(len(names), 1.0 / len(names))
    drawn = np.random.default_rng(0).multinomial(len(names), share, RESAMPLES)
    rows = [np.flatnonzero(cluster == name) for name in names]
    return [
        np.concatenate([np.tile(rows[k], times) for k, times in enumerate(each)]) for each in drawn
    ]


def test_a_discounted_sum_counts_the_first_decision_whole() -> None:
    values = np.array([[1.0, 1.0, 1.0], [0.0, 2.0, 4.0]])
    assert discounted(values, 0.5) == pytest.approx([1.75, 2.0])
    assert discounted(values != 0, 1.0).tolist() == [3.0, 2.0]


def test_the_interval_of_a_mean_is_that_of_resampled_worlds() -> None:
    _, realised, world = invented(0.5, 0.0)
    means = [realised[rows].mean() for rows in resampled(world)]
    expected = np.quantile(means, [0.025, 0.975])
    assert mean_interval(realised, world, resamples=RESAMPLES) == pytest.approx(tuple(expected))


def test_bins_share_out_the_interventions_by_predicted_gain() -> None:
    predicted, realised, world = invented(0.5, 0.0)
    bins = gain_bins(predicted, realised, world, bins=4, resamples=RESAMPLES)
    assert sum(each.size for each in bins) == len(predicted)
    assert [each.predicted for each in bins] == sorted(each.predicted for each in bins)
    edges = [-np.inf, *np.quantile(predicted, [0.25, 0.5, 0.75]), np.inf]
    for each, low, high in zip(bins, edges, edges[1:], strict=False):
        here = (predicted > low) & (predicted <= high)
        assert each.size == here.sum()
        assert each.predicted == pytest.approx(predicted[here].mean())
        assert each.realised == pytest.approx(realised[here].mean())
        assert each.interval == mean_interval(realised[here], world[here], resamples=RESAMPLES)


def test_there_are_fewer_bins_of_few_interventions_and_equal_predictions_stay_together() -> None:
    predicted, realised, world = invented(0.5, 0.0, rows=25)
    assert len(gain_bins(predicted, realised, world, least=10)) == 2
    assert len(gain_bins(predicted[:9], realised[:9], world[:9], least=10)) == 1
    alike = gain_bins(np.full(25, 0.3), realised, world, least=1)
    assert [each.size for each in alike] == [25]
    nothing = np.zeros(0)
    assert gain_bins(nothing, nothing, nothing) == []


def test_the_slope_is_that_of_least_squares_in_every_resample() -> None:
    predicted, realised, world = invented(0.5, 0.0)
    flat = flatness(predicted, realised, world, resamples=RESAMPLES)
    slopes = [np.polyfit(predicted[rows], realised[rows], 1)[0] for rows in resampled(world)]
    assert flat.slope == pytest.approx(np.polyfit(predicted, realised, 1)[0])
    assert flat.slope_interval == pytest.approx(tuple(np.quantile(slopes, [0.025, 0.975])))
    assert flat.slope_interval.low < 0.5 < flat.slope_interval.high


def test_a_picture_is_flat_where_predictions_say_nothing() -> None:
    flat = flatness(*invented(0.0, 0.3))
    assert flat.slope_interval.low < 0.0 < flat.slope_interval.high
    assert flat.rank_interval.low < 0.0 < flat.rank_interval.high
    true = flatness(*invented(1.0, 0.0))
    assert true.slope_interval.low > 0.5
    assert true.rank_interval.low > 0.5


def holds_from_by_hand(predicted: Column, realised: Column, world: Column) -> float | None:
    for least in np.unique(predicted):
        here = predicted >= least
        means = [realised[rows[here[rows]]].mean() for rows in resampled(world) if here[rows].any()]
        if len(np.unique(world[here])) >= CLUSTERS and np.quantile(means, 0.025) > 0:
            return float(least)
    return None


@pytest.mark.parametrize("offset", [0.4, -0.8, -1.2, -5.0])
def test_predictions_hold_from_the_first_gain_above_which_the_mean_is_above_0(
    offset: float,
) -> None:
    rows = invented(0.8, offset)
    expected = holds_from_by_hand(*rows)
    assert holds_from(*rows, resamples=RESAMPLES) == expected
    if offset == 0.4:
        assert expected == rows[0].min()
    elif offset == -5.0:
        assert expected is None
    else:
        assert expected is not None
        assert expected > rows[0].min()


def test_the_order_of_the_rows_does_not_matter() -> None:
    rows = invented(0.8, -0.8)
    mixed = np.random.default_rng(1).permutation(len(rows[0]))
    assert holds_from(*rows) == holds_from(*(column[mixed] for column in rows))
    assert flatness(*rows).rank == pytest.approx(flatness(*(row[mixed] for row in rows)).rank)


def test_few_worlds_conclude_nothing() -> None:
    predicted, realised, world = invented(1.0, 1.0)
    one = np.zeros_like(world)
    assert np.isnan(mean_interval(realised, one)).all()
    assert np.isnan(flatness(predicted, realised, one).slope_interval).all()
    assert flatness(predicted, realised, one).slope == pytest.approx(1.0, abs=0.2)
    assert holds_from(predicted, realised, one) is None
    assert holds_from(predicted, realised, world % (CLUSTERS - 1)) is None
    assert holds_from(predicted, realised, world % CLUSTERS) is not None


def test_nothing_and_a_prediction_that_never_varies_have_no_slope() -> None:
    nothing = np.zeros(0)
    assert np.isnan(flatness(nothing, nothing, nothing).slope)
    assert holds_from(nothing, nothing, nothing) is None
    predicted, realised, world = invented(1.0, 1.0)
    still = flatness(np.full_like(predicted, 0.1), realised, world)
    assert np.isnan([still.slope, still.rank, *still.slope_interval]).all()
