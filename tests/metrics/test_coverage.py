from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from wasp_cli.errors import WaspError
from wasp_cli.metrics.coverage import clopper_pearson, coverage_threshold, episode_score

SIGNALS = st.lists(st.floats(0, 10, width=32), min_size=1, max_size=30)


def unalerted(signal: np.ndarray, cost: np.ndarray, window: int, threshold: float) -> bool:
    """Whether an episode has an onset without an alert, word for word."""
    for t in range(len(cost)):
        onset = cost[t] and not (t > 0 and cost[t - 1])
        if onset and not any(np.float32(signal[u]) > np.float32(threshold) for u in range(max(0, t - window + 1), t + 1)):
            return True
    return False


def test_a_score_by_hand() -> None:
    signal = np.array([0.1, 0.9, 0.2, 0.3, 0.4, 0.8])
    assert episode_score(signal, np.zeros(6), 3) is None
    assert episode_score(signal, np.array([0, 0, 0, 1, 1, 0]), 3) == 0.9  # decisions 1 to 3
    assert episode_score(signal, np.array([0, 0, 0, 1, 1, 0]), 2) == 0.3
    assert episode_score(signal, np.array([1, 1, 0, 0, 0, 1]), 3) == 0.1  # the first decision has none before it
    assert episode_score(signal, np.array([0, 0, 1, 1, 1, 1]), 1) == 0.2  # what goes on costing is no onset


@given(SIGNALS, st.integers(1, 8), st.data())
def test_an_episode_goes_unalerted_exactly_where_its_score_is_not_above_the_threshold(
    values: list[float], window: int, data: st.DataObject
) -> None:
    signal = np.array(values, np.float32)
    cost = np.array(data.draw(st.lists(st.booleans(), min_size=len(values), max_size=len(values))))
    threshold = data.draw(st.one_of(st.sampled_from(values), st.floats(0, 10, width=32)))
    score = episode_score(signal, cost, window)
    assert (score is None) == (not cost.any())
    assert unalerted(signal, cost, window, threshold) == (score is not None and score <= threshold)


@given(st.lists(st.floats(0, 10, width=32), min_size=1, max_size=60), st.floats(0.01, 0.99))
def test_the_threshold_is_the_largest_that_leaves_room_for_the_share(scores: list[float], eps: float) -> None:
    """Brute force: raise the threshold score by score, as long as fewer than eps (n + 1) episodes lie below it."""
    n = len(scores)
    allowed = [score for score in scores if sum(other < score for other in scores) + 1 <= eps * (n + 1) + 1e-9]
    if not allowed:
        with pytest.raises(WaspError):
            coverage_threshold(scores, eps, n)
        return
    found = coverage_threshold(scores, eps, n)
    assert found.score == max(allowed)
    assert np.float32(found.score) > np.float32(found.value)  # an episode with exactly this score is alerted
    assert not any(found.value < score < found.score for score in scores)


@pytest.mark.parametrize(("eps", "least"), [(0.1, 9), (0.05, 19), (0.5, 1), (0.3, 3), (0.01, 99)])
def test_too_few_costly_episodes_are_refused_with_a_way_out(eps: float, least: int) -> None:
    assert coverage_threshold([0.5] * least, eps, 200).k == 1
    with pytest.raises(WaspError, match=f"needs {least} costly episodes .* {least - 1} of 40 cost anything") as caught:
        coverage_threshold([0.5] * (least - 1), eps, 40)
    assert "coverage.episodes" in str(caught.value.hint)


@pytest.mark.parametrize("n", [1, 4, 6, 8])
def test_what_the_hint_says_is_enough(n: int) -> None:
    with pytest.raises(WaspError) as caught:
        coverage_threshold([0.1] * n, 0.1, 60)
    advised = float(str(caught.value.hint).rpartition(" ")[2])
    assert coverage_threshold([0.1] * n, advised, 60).k == 1


def test_without_any_cost_only_more_episodes_help() -> None:
    with pytest.raises(WaspError, match="0 of 60 cost anything") as caught:
        coverage_threshold([], 0.1, 60)
    assert str(caught.value.hint) == "set coverage.episodes to 810 or more"


@pytest.mark.parametrize(("eps", "n"), [(0.1, 9), (0.1, 30), (0.25, 12), (0.5, 5)])
def test_coverage_holds_for_exchangeable_episodes(eps: float, n: int) -> None:
    """Episodes of very different lengths, difficulties and signals, some without any cost: the share of misses stays below eps."""
    random = np.random.default_rng(7)

    def episode() -> float | None:
        steps, skill = random.integers(5, 60), random.random()
        risk = np.convolve(random.random(steps) < 0.08, np.ones(4))[:steps]
        signal = skill * risk + random.exponential(0.3, steps)  # a bad model alerts too late
        return episode_score(signal.astype(np.float32), np.roll(risk, 1) > 0, 5)

    def costly(count: int) -> list[float]:
        found: list[float] = []
        while len(found) < count:
            score = episode()
            found += [] if score is None else [score]
        return found

    trials = 600
    misses = sum(costly(1)[0] <= coverage_threshold(costly(n), eps, 2 * n).value for _ in range(trials))
    exact = np.floor(eps * (n + 1) + 1e-9) / (n + 1)  # what the bound is for continuous signals
    assert misses / trials == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / trials))
    assert exact <= eps + 1e-9


@settings(max_examples=60)
@given(st.integers(0, 80), st.integers(0, 80), st.sampled_from([0.8, 0.95, 0.99]))
def test_intervals_of_shares_are_exact(hits: int, others: int, level: float) -> None:
    low, high = clopper_pearson(hits, hits + others, level)
    if hits + others == 0:
        assert (low, high) == (0.0, 1.0)
        return
    wanted = binomtest(hits, hits + others).proportion_ci(level, "exact")
    assert (low, high) == (pytest.approx(wanted.low, abs=1e-9), pytest.approx(wanted.high, abs=1e-9))
