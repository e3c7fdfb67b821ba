import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.stats import pearsonr, spearmanr

from tests.plans import joined, plans_of, trajectory
from wasp_cli.metrics.episode import WEIGHTS, EpisodeMetrics, Trajectory, episode_metrics, pool
from wasp_cli.metrics.necessity import necessity
from wasp_cli.metrics.ranking import (
    average_precision,
    average_precision_interval,
    correlations,
    recall_at,
)
from wasp_cli.metrics.reliability import BINS, calibration_error, reliability
from wasp_cli.metrics.windows import sums_ahead
from wasp_cli.tasks.motors import Motors


def columns(rows: list[EpisodeMetrics]) -> dict[str, Any]:
    names = [*WEIGHTS, "decisions", "env_steps", "intervened", "planned", "handovers"]
    return {
        name: np.array(
            [getattr(row, "return_" if name == "return" else name) for row in rows], np.float64
        )
        for name in names
    }


def test_by_hand():
    episode = trajectory(
        reward=[1.0, 0.5, -0.25, 2.0],
        cost=[False, True, True, False],
        cost_env=[0, 3, 1, 0],
        env_steps=[4, 4, 4, 2],
        goals=[0, 1, 0, 1],
        a_h=[[0, 0], [0.5, 0], [0, 0], [1, 1]],
        a=[[0, 0], [0.5, 0.3], [0.04, 0], [1, 1]],
        gate=[0, 1, 2, 0],
        plans=plans_of([np.nan, 0.5, 0.0, np.nan]),
    )
    row = episode_metrics(episode, success_goals=2, safe_cost=285.0)
    assert (row.decisions, row.env_steps, row.goals, row.cost) == (4, 14, 2, 4)
    assert row.return_ == 3.25
    assert row.success
    assert not row.safe_success  # 4 in 14 env steps are 286 in 1000
    assert row.violated
    assert row.viol == 0.5
    assert row.viol_env == pytest.approx(4 / 14)
    assert (row.int_rate, row.int_rate_05, row.int_rate_10) == (0.5, 0.25, 0.25)
    assert row.mag == pytest.approx((0.3 + 0.04) / 4)
    assert row.mag_int == pytest.approx((0.3 + 0.04) / 2)
    # jumps: (0.5, 0.3), (-0.46, -0.3), (0.96, 1)
    assert row.smoothness == pytest.approx((0.34 + 0.3016 + 1.9216) / 3)
    assert (row.safety_gate, row.task_gate, row.case2) == (0.25, 0.25, 0.25)


def test_undefined_is_none_not_zero():
    row = episode_metrics(trajectory(), 1, 25.0)
    assert (row.mag_int, row.case2) == (None, None)
    assert (row.int_rate, row.mag) == (0.0, 0.0)
    assert episode_metrics(trajectory(steps=1), 1, 25.0).smoothness is None


def test_rounding_is_no_intervention_and_what_is_no_rounding_is_one():
    row = episode_metrics(trajectory(a=np.full((4, 2), 5e-7)), 1, 25.0)  # norm 7e-7
    assert (row.int_rate, row.mag, row.intervened) == (0.0, 0.0, 0)
    row = episode_metrics(trajectory(a=[[2e-6, 0], [0, 1e-5], [0, 0], [1e-4, 0]]), 1, 25.0)
    assert (row.int_rate, row.intervened, row.int_rate_05) == (0.75, 3, 0.0)
    assert row.mag == pytest.approx((2e-6 + 1e-5 + 1e-4) / 4)


def test_a_short_episode_is_held_to_kappa_as_strictly_as_a_long_one():
    """Kappa counts per 1000 env steps, as in training: 20 is little in an episode of 1000 and
    too much in one of 500.
    """

    def row(steps: int) -> EpisodeMetrics:
        cost_env = [1] * 20 + [0] * (steps - 20)
        return episode_metrics(
            trajectory(
                steps=steps,
                goals=[1] + [0] * (steps - 1),
                cost=np.array(cost_env) > 0,
                cost_env=cost_env,
            ),
            1,
            25.0,
        )

    assert (row(250).env_steps, row(250).safe_success) == (1000, True)
    assert (row(125).env_steps, row(125).safe_success) == (500, False)


ACTIONS = hnp.arrays(
    np.float64, st.tuples(st.integers(1, 12), st.just(2)), elements=st.floats(-1, 1, width=32)
)


@given(st.lists(st.tuples(ACTIONS, st.integers(0, 2**32 - 1)), min_size=1, max_size=5))
def test_mag_is_int_times_mag_given_int(episodes):
    rows = []
    for a, seed in episodes:
        acts = np.random.default_rng(seed).random(len(a)) < 0.5
        rows.append(
            episode_metrics(
                trajectory(steps=len(a), a=a, a_h=np.where(acts[:, None], -a, a)), 1, 25.0
            )
        )
    for row in rows:
        assert row.mag == pytest.approx(row.int_rate * (row.mag_int or 0.0), abs=1e-12)
    pooled = pool(columns(rows))
    assert pooled["mag"][0] == pytest.approx(
        pooled["int_rate"][0] * np.nan_to_num(pooled["mag_int"][0]), abs=1e-12
    )


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_pooling_is_the_metric_of_the_joined_steps(episodes, seed):
    """Rates of a cell are those of one long episode made of all its steps."""
    rng = np.random.default_rng(seed)

    def invent(steps: int) -> Trajectory:
        cost_env = rng.integers(0, 3, steps)
        case2 = np.where(rng.random(steps) < 0.5, rng.integers(0, 5, steps) / 4, np.nan)
        a, a_h = rng.uniform(-1, 1, (2, steps, 2)) * (rng.random((steps, 1)) < 0.5)
        gate = rng.integers(0, 3, steps)
        return trajectory(
            steps,
            cost=cost_env > 0,
            cost_env=cost_env,
            a=a,
            a_h=a_h,
            gate=gate,
            plans=plans_of(case2),
        )

    parts = [invent(int(rng.integers(1, 9))) for _ in range(episodes)]
    one = trajectory(
        sum(part.steps for part in parts),
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("cost", "cost_env", "a", "a_h", "gate")
        },
        plans=joined([part.plans for part in parts if part.plans is not None]),
    )
    whole, pooled = (
        episode_metrics(one, 1, 25.0),
        pool(columns([episode_metrics(part, 1, 25.0) for part in parts])),
    )
    for name in (
        "viol",
        "viol_env",
        "int_rate",
        "int_rate_05",
        "int_rate_10",
        "mag",
        "mag_int",
        "safety_gate",
        "task_gate",
        "case2",
    ):
        expected = getattr(whole, name)
        assert pooled[name][0] == pytest.approx(
            np.nan if expected is None else expected, nan_ok=True
        )


@pytest.mark.parametrize(
    "changes",
    [
        {"reward": [0.0, np.nan, 0, 0]},
        {"a": np.zeros((4, 3))},
        {"cost": np.zeros(3, bool)},
        {"a": np.full((4, 2), np.inf)},
    ],
    ids=["reward", "action-size", "length", "action"],
)
def test_refuses_what_cannot_be_measured(changes):
    with pytest.raises(ValueError, match=r"reward|shape|finite"):
        trajectory(**changes)


def test_refuses_plans_of_other_steps():
    with pytest.raises(
        ValueError, match=r"plans\.residuals has shape \(3, 3, 2\), not \(4, 3, 2\)"
    ):
        trajectory(plans=plans_of([0.5, np.nan, 0.0]))


MOTORS = Motors((0.02, 0.5))


def invent(rng: np.random.Generator, steps: int) -> Trajectory:
    """Commands and actions of which many are beyond the motors, some equal, and some equal but
    for rounding.
    """
    a_h = rng.uniform(-1, 1, (steps, 2)) * rng.choice([0.02, 1.0], (steps, 1))
    wanted = rng.uniform(-1, 1, (steps, 2))
    kind = rng.integers(0, 4, steps)[:, None]
    a = np.where(
        kind == 0,
        a_h,
        np.where(kind == 1, a_h + 4e-7, np.where(kind == 2, np.sign(a_h) * 0.75, wanted)),
    )
    return trajectory(steps, a_h=a_h, a=np.clip(a, -1, 1))


def loops(episode: Trajectory) -> tuple[list[float], list[float]]:
    """The distance of the forces at every step, and the change of the action at every change of
    hands.
    """
    distances, changes = [], []
    before = None
    for t in range(episode.steps):
        acts = math.dist(episode.a[t], episode.a_h[t]) > 1e-6
        apart = math.dist(MOTORS.force(episode.a[t]), MOTORS.force(episode.a_h[t]))
        distances.append(apart if acts and apart > 1e-6 else 0.0)
        if before is not None and acts != before:
            changes.append(math.dist(episode.a[t], episode.a[t - 1]))
        before = acts
    return distances, changes


def mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_rates_of_an_episode_and_of_a_cell_are_ratios_of_sums_over_the_steps(episodes, seed):
    rng = np.random.default_rng(seed)
    parts = [invent(rng, int(rng.integers(1, 12))) for _ in range(episodes)]
    rows = [episode_metrics(part, 1, 25.0, MOTORS.force) for part in parts]
    distances, changes = zip(*map(loops, parts), strict=True)
    for row, apart, jumps in zip(rows, distances, changes, strict=True):
        assert row.int_eff == mean([float(each > 0) for each in apart]) <= row.int_rate
        assert row.mag_eff == pytest.approx(mean(apart))
        assert row.handovers == len(jumps)
        assert row.jump is None if not jumps else row.jump == pytest.approx(mean(jumps))
    pooled = pool(columns(rows))
    assert pooled["int_eff"][0] == pytest.approx(
        mean([float(each > 0) for apart in distances for each in apart])
    )
    assert pooled["mag_eff"][0] == pytest.approx(
        mean([each for apart in distances for each in apart])
    )
    assert pooled["jump"][0] == pytest.approx(
        mean([each for jumps in changes for each in jumps]), nan_ok=True
    )


def test_there_is_no_jump_without_a_handover_and_the_action_is_its_force_without_motors():
    always = trajectory(a=np.full((4, 2), 0.3))
    row = episode_metrics(always, 1, 25.0, Motors().force)
    assert (row.jump, row.handovers) == (None, 0)
    assert (
        (row.int_eff, row.mag_eff)
        == (row.int_rate, row.mag)
        == (1.0, pytest.approx(math.hypot(0.3, 0.3)))
    )
    assert row == episode_metrics(always, 1, 25.0)
    quiet = episode_metrics(trajectory(steps=1), 1, 25.0, MOTORS.force)
    assert (quiet.int_eff, quiet.mag_eff, quiet.jump) == (0.0, 0.0, None)


def brute_force(event: list[bool], score: list[int]) -> float:
    total, previous, area = sum(event), 0.0, 0.0
    for threshold in sorted(set(score), reverse=True):
        chosen = [e for e, s in zip(event, score, strict=True) if s >= threshold]
        recall = sum(chosen) / total
        area += (recall - previous) * sum(chosen) / len(chosen)
        previous = recall
    return area


@given(
    st.lists(st.tuples(st.booleans(), st.integers(0, 4)), min_size=1, max_size=40).filter(
        lambda rows: any(e for e, _ in rows)
    )
)
def test_average_precision_is_the_step_sum(rows):
    event, score = zip(*rows, strict=True)
    found = average_precision(np.array(event), np.array(score, float))
    assert found == pytest.approx(brute_force(list(event), list(score)))


@given(
    st.lists(st.tuples(st.booleans(), st.integers(0, 6)), min_size=1, max_size=40).filter(
        lambda rows: any(e for e, _ in rows)
    ),
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
    assert (found.pearson, found.rank) == pytest.approx(
        (pearsonr(score, value).statistic, spearmanr(score, value).statistic)
    )
    drawn = np.random.default_rng(4).multinomial(4, np.full(4, 0.25), 7)
    for row, counts in zip(found.resampled, drawn, strict=True):
        rows = np.concatenate(
            [
                np.flatnonzero(episode == e)
                for e, n in zip((3, 5, 6, 9), counts, strict=True)
                for _ in range(n)
            ]
        )
        assert row.tolist() == pytest.approx(
            [
                pearsonr(score[rows], value[rows]).statistic,
                spearmanr(score[rows], value[rows]).statistic,
            ]
        )
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
        here = [
            i
            for i, p in enumerate(probability)
            if number / BINS <= p < (number + 1) / BINS or (number == BINS - 1 and p == 1.0)
        ]
        assert row.size == len(here)
        predicted, seen = (
            sum(probability[i] for i in here) / len(here),
            sum(bool(event[i]) for i in here) / len(here),
        )
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


def test_necessity_by_hand():
    cost_cf = np.array([[0.0, 1, 1], [0, 0, 0], [1, 0, 0], [0, 0, 0]])
    cost_asst = np.array([[0.0, 0, 1], [0, 0, 0], [1, 1, 0], [0, 0, 0]])
    reward_cf = np.array([[1.0, 1, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    reward_asst = np.array([[1.0, 0, 0], [0.25, 0.25, 0], [0, 0, 0], [1, 0, 0]])
    found = necessity(cost_cf, cost_asst, reward_cf, reward_asst, tau_R=0.5)
    assert found.rho.tolist() == pytest.approx([2 / 3, 0, 1 / 3, 0])
    assert found.delta_c.tolist() == [1, 0, -1, 0]
    assert found.delta_r.tolist() == [-2, 0.5, 0, 1]
    # Cost avoided; gain equal to the threshold; cost added without gain; gain above the threshold.
    assert found.unnecessary.tolist() == [False, True, True, False]
    assert found.uir == 0.5
    # The command gained more than the threshold; loses as much; avoided a cost; loses more.
    assert found.swapped.tolist() == [False, True, False, True]
    assert found.uir_swapped == 0.5


def test_rate_of_no_intervention_is_undefined():
    nothing = np.zeros((0, 15))
    found = necessity(nothing, nothing, nothing, nothing, 0.1)
    assert all(math.isnan(rate) for rate in (found.uir, found.uir_swapped, found.uir_eff))


BRANCHES = hnp.arrays(np.float64, (4, 9, 3), elements=st.sampled_from([0.0, 0.25, 1.0]))


@given(BRANCHES, st.sampled_from([0.0, 0.25, 0.6]))
def test_swapped_judges_the_branches_in_each_others_place_and_effective_leaves_out_twins(
    branches, tau_R
):
    cost_cf, cost_asst, reward_cf, reward_asst = branches
    cost_cf, cost_asst = cost_cf.round(), cost_asst.round()
    found = necessity(cost_cf, cost_asst, reward_cf, reward_asst, tau_R)
    assert found.uir_swapped == necessity(cost_asst, cost_cf, reward_asst, reward_cf, tau_R).uir
    unnecessary = []
    for i in range(9):
        differs = any(
            cost_cf[i, w] != cost_asst[i, w] or reward_cf[i, w] != reward_asst[i, w]
            for w in range(3)
        )
        assert found.effective[i] == differs
        assert differs or found.unnecessary[i]
        unnecessary += [found.unnecessary[i]] * differs
    assert found.uir_eff == pytest.approx(
        np.mean(unnecessary) if unnecessary else math.nan, nan_ok=True
    )


def test_refuses_branches_of_different_length():
    with pytest.raises(ValueError, match="same shape"):
        necessity(np.zeros((2, 15)), np.zeros((2, 14)), np.zeros((2, 15)), np.zeros((2, 15)), 0.1)
