import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import pearsonr, spearmanr

from wasp_cli.metrics.ranking import average_precision, average_precision_interval, correlations, recall_at
from wasp_cli.metrics.reliability import BINS, calibration_error, reliability
from wasp_cli.metrics.windows import sums_ahead


def brute_force(event: list[bool], score: list[int]) -> float:
    total, previous, area = sum(event), 0.0, 0.0
    for threshold in sorted(set(score), reverse=True):
        chosen = [e for e, s in zip(event, score, strict=True) if s >= threshold]
        recall = sum(chosen) / total
        area += (recall - previous) * sum(chosen) / len(chosen)
        previous = recall
    return area


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 4)), min_size=1, max_size=40).filter(lambda rows: any(e for e, _ in rows)))
def test_average_precision_is_the_step_sum(rows):
    event, score = zip(*rows, strict=True)
    found = average_precision(np.array(event), np.array(score, float))
    assert found == pytest.approx(brute_force(list(event), list(score)))


@given(
    st.lists(st.tuples(st.booleans(), st.integers(0, 6)), min_size=1, max_size=40).filter(lambda rows: any(e for e, _ in rows)),
    st.sampled_from([0.0, 0.1, 0.3]),
)
def test_recall_is_the_best_of_all_thresholds_with_so_few_false_alarms(rows, share):
    best, quiet = 0.0, [s for e, s in rows if not e]
    for threshold in range(8):
        if sum(s >= threshold for s in quiet) <= share * len(quiet):
            best = max(best, sum(e and s >= threshold for e, s in rows) / sum(e for e, _ in rows))
    event, score = zip(*rows, strict=True)
    assert recall_at(np.array(event), np.array(score, float), share) == pytest.approx(best)


def test_the_interval_is_that_of_explicitly_resampled_episodes():
    random = np.random.default_rng(5)
    episode = np.repeat(np.arange(6), [30, 10, 25, 5, 40, 12])
    event = random.random(len(episode)) < 0.05 + 0.1 * episode
    score = np.round(event + random.normal(size=len(episode)), 1)  # with ties
    draws = np.random.default_rng(3).multinomial(6, np.full(6, 1 / 6), 50)
    values = []
    for counts in draws:
        rows = np.repeat(np.arange(len(episode)), counts[episode])
        values.append(average_precision(event[rows], score[rows]))
    wanted = np.quantile(values, [0.1, 0.9])
    found = average_precision_interval(event, score, episode * 7, resamples=50, share=0.8, seed=3)
    assert found == pytest.approx(tuple(wanted))
    assert found[0] < average_precision(event, score) < found[1]


def test_correlations_are_scipys_on_explicitly_resampled_episodes():
    random = np.random.default_rng(2)
    episode = np.repeat([3, 5, 6, 9], [10, 20, 5, 15])
    score, value = random.integers(0, 6, 50).astype(float), random.normal(size=50) + 0.2 * episode
    found = correlations(score, value, episode, resamples=7, seed=4)
    assert (found.pearson, found.rank) == pytest.approx((pearsonr(score, value).statistic, spearmanr(score, value).statistic))
    drawn = np.random.default_rng(4).multinomial(4, np.full(4, 0.25), 7)
    for row, counts in zip(found.resampled, drawn, strict=True):
        rows = np.concatenate([np.flatnonzero(episode == e) for e, n in zip((3, 5, 6, 9), counts, strict=True) for _ in range(n)])
        assert row.tolist() == pytest.approx([pearsonr(score[rows], value[rows]).statistic, spearmanr(score[rows], value[rows]).statistic])
    assert correlations(score[:5], value[:5], episode[:5]).resampled.shape == (0, 2)
    assert np.isnan(correlations(np.ones(50), value, episode, resamples=2).resampled).all()


def test_windows_do_not_cross_episodes():
    values, episode = np.arange(6.0), np.array([0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(sums_ahead(values, episode, 2), [1, 3, np.nan, 7, 9, np.nan])
    assert np.isnan(sums_ahead(values, episode, 4)).all()
    assert np.isnan(sums_ahead(values[:1], episode[:1], 4)).all()


def test_bins_and_their_error_are_what_loops_count():
    random = np.random.default_rng(0)
    probability = np.append(random.random(500) ** 3, [0.0, 1.0])
    event = random.random(502) < probability
    rows, error = reliability(event, probability), 0.0
    for number, row in enumerate(rows):
        here = [i for i, p in enumerate(probability) if number / BINS <= p < (number + 1) / BINS or (number == BINS - 1 and p == 1.0)]
        assert row.size == len(here)
        predicted, seen = sum(probability[i] for i in here) / len(here), sum(bool(event[i]) for i in here) / len(here)
        assert row.predicted == pytest.approx(predicted)
        assert row.seen == pytest.approx(seen)
        error += abs(predicted - seen) * len(here) / 502
    assert sum(row.size for row in rows) == 502
    assert calibration_error(rows) == pytest.approx(error)


def test_empty_bins_are_not_counted():
    rows = reliability(np.array([True, False]), np.array([0.95, 0.95]))
    assert [row.size for row in rows] == [0] * 9 + [2]
    assert np.isnan(rows[0].seen)
    assert calibration_error(rows) == pytest.approx(0.45)
