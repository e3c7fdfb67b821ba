import numpy as np
import pytest

from wasp_cli.metrics.reliability import BINS, calibration_error, reliability


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
