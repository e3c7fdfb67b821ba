"""Other rules, the other WASPs, late assistants and searches that were cut off, as `wasp
explain` tells them.
"""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.commands import run_here
from tests.report.explained import (
    KEY,
    NAN,
    PRINTED,
    WASP,
    Invented,
    decision_text,
    episode_text,
    text_of,
)
from wasp_cli.metrics.episode import (
    CUT_OFF,
    GATE_LATE,
    GATE_METHOD,
    GATE_SAFETY,
    GATE_TASK,
    Plans,
    episode_metrics,
)
from wasp_cli.report.explain.episode import Episode
from wasp_cli.report.explain.facts import (
    decision_json,
    episode_json,
    merged_runs,
    places_of,
    runs_of,
)
from wasp_cli.report.explain.text import decision_lines, episode_lines
from wasp_cli.report.explain.timeline import timeline
from wasp_cli.store.tables import Thresholds


def test_a_method_that_votes(tmp_path: Path) -> None:
    made = Invented(method="ida", thresholds=Thresholds(tau_q=0.1), config={"vote": 0.99})
    made.signal[:] = -0.2
    made.signal[3], made.gate[3], made.a[3] = 1.0, GATE_METHOD, [0.0, 0.0]
    made.pay(3, 4)
    episode = made.read(tmp_path)
    text = decision_text(episode, 3)
    assert (
        "  signal  value  threshold    τ_Q  intervenes\n  vote    1.000      0.990  0.100  yes\n"
        in text
    )
    assert (
        "vote: on a scale from -1 (no member of the ensemble prefers the copilot's action "
        "by more than τ_Q) to 1" in text
    )
    assert "IDA intervened: the command was changed by" in text
    assert "Plan\n" not in text
    assert "safety gate" not in text
    assert "The command was executed." in decision_text(episode, 4)
    summary = episode_text(episode)
    assert (
        "  IDA   vote > 0.990          1  12.5%\n  none  -                     7  87.5%\n"
        in summary
    )
    assert places_of(episode.missed) == (4,)
    assert (
        "  3          IDA   1 of 1, by 0.56  (+0.50, -0.25) → (+0.00, +0.00)   1.000     2 "
        "         -" in summary
    )


def test_a_filter_has_a_threshold_of_cost_and_none_of_the_gates(tmp_path: Path) -> None:
    made = Invented(method="filter", thresholds=Thresholds(tau_c=0.4), config={})
    made.signal[:] = 0.1
    made.signal[3], made.gate[3], made.a[3] = 0.7, GATE_METHOD, [0.0, 0.0]
    episode = made.read(tmp_path)
    assert (
        "  signal  value  threshold  intervenes\n  Q_c     0.700      0.400  yes\n"
        in decision_text(episode, 3)
    )
    assert "  Safety filter  Q_c > 0.400          1  12.5%\n" in episode_text(episode)
    assert "safety gate" not in episode_text(episode) + decision_text(episode, 3)


def test_behind_a_vote_the_safety_gate_looks_at_what_was_voted_for(tmp_path: Path) -> None:
    made = Invented(
        method="ida-guarded",
        thresholds=Thresholds(tau_c=0.3, tau_q=0.1),
        config={**WASP, "vote": 0.99},
    )
    made.signal[:], made.g_cost[:], made.delta_g[:] = 0.2, 0.125, 0.25
    made.signal[3], made.gate[3], made.a[3] = 1.0, GATE_METHOD, [0.0, 0.0]
    made.signal[4], made.gate[4], made.g_cost[4] = 1.0, GATE_SAFETY, 0.5
    voted, guarded = (decision_text(made.read(tmp_path), t) for t in (3, 4))
    for text in (voted, guarded):
        assert "  vote    1.000      0.990  0.100  yes\n" in text
        assert (
            "within the next 4 decisions, discounted, if the expert follows IDA's action (Eq. 9)"
            in text
        )
        assert "this assistant has no such gate" in text
    assert "search  none: the method decided by its own rule" in voted
    assert "The safety gate fired (G^c 0.500 > τ_c 0.300)" in guarded


def test_the_printed_wasp_probes_and_imagines_the_operator(tmp_path: Path) -> None:
    made = Invented(method="printed", config=dict(PRINTED))
    made.fire(2, GATE_SAFETY)
    made.fire(6, GATE_TASK, safe=(12, 25, 30))
    made.delta_g[1] = NAN
    episode = made.read(tmp_path)
    assert (
        "  task    ΔG -       τ_r 0.500  no: no correction is predicted safe (Eq. 11)"
        in decision_text(episode, 1)
    )
    text = decision_text(episode, 6)
    assert "ΔG: expected gain in return by the best safe correction of 20 that are tried" in text
    assert (
        "expected discounted cost if the operator goes on alone, with the critic beyond the horizon"
        in text
    )
    assert "\n  2                    25  I\n" in text
    text = decision_text(episode, 2)
    assert "  task    ΔG -       τ_r 0.500  not asked: the safety gate fired" in text
    assert "  commands alone            0.600" in text
    assert "other rollouts" not in text, "it plans on the rollouts of its gates"


@pytest.fixture
def late(tmp_path: Path) -> Episode:
    """Late three times, two of them with cost; one cost was missed, one paid although a gate
    fired.
    """
    made = Invented()
    made.fire(2, GATE_SAFETY)
    for t in (4, 5, 6):
        made.gate[t], made.g_cost[t], made.g_return[t], made.delta_g[t] = GATE_LATE, NAN, NAN, NAN
    made.pay(1, 2, 4, 6)
    return made.read(tmp_path)


def test_late_is_not_missed(late: Episode) -> None:
    text = " ".join(episode_text(late).split())
    assert (
        "4 decisions with cost, 1 of them missed (no gate fired), 2 while the assistant was late."
        in text
    )
    assert "1 missed, 1 although a gate fired, 2 while the assistant was late" in text
    assert "late no answer in time 3 37.5%" in text
    assert (places_of(late.missed), places_of(late.late)) == ((1,), (4, 6))
    assert episode_json(late)["totals"]["gate_share"]["late"] == 3 / 8


def test_a_late_decision_asked_no_gate(late: Episode) -> None:
    text = decision_text(late, 4)
    assert "The assistant had not answered in time: the command was executed." in text
    assert text.count("not asked: the assistant was late") == 2
    assert "search  none: the assistant was late" in text
    assert "no gate fired" not in text.lower()
    acts = next(lane for lane in timeline(late) if lane.name == "acts")
    assert acts.marks == [("safety", 2, 1), ("late", 4, 3)]


def test_a_search_that_was_cut_off_shows_the_iterations_that_it_made(tmp_path: Path) -> None:
    made = Invented()
    made.fire(2, GATE_SAFETY, safe=(CUT_OFF, 4, 12))
    made.plans.case2[2] = [False, True, False]
    assert made.plans.share()[2] == 0.5, "of those that were made"
    assert episode_metrics(made.trajectory(), 7, 25.0).case2 == 0.5
    text = " ".join(decision_text(made.read(tmp_path), 2).split())
    assert "case 1 4 II 2 12 I " in text
    assert "the search was cut off before its last 1 iteration: its time was up" in text
    assert np.isnan(made.plans.share()[0])


# Whatever a table holds can be explained.


numbers = st.one_of(st.just(NAN), st.floats(-2, 2), st.sampled_from([0.0, 0.3, 1e6]))
thresholds = st.one_of(st.none(), st.just(NAN), st.floats(-1, 2), st.just(0.0))


@st.composite
def cells(draw: st.DrawFn) -> Invented:
    method = draw(
        st.sampled_from(["wasp", "printed", "ida", "filter", "human", "diffusion", "theirs"])
    )
    variant = draw(
        st.sampled_from(["full", "safety-only", "task-only", "no-case2", "no-rollout", "own"])
    )
    limits = Thresholds(draw(thresholds), draw(thresholds), draw(thresholds))
    config = draw(
        st.sampled_from([{}, WASP, PRINTED, {"vote": 0.5}, {"horizon": "long", "feasible": None}])
    )
    made = Invented(
        draw(st.integers(1, 6)), method, variant, limits, dict(config), draw(st.integers(1, 2))
    )

    def series(elements: Callable[[], Any]) -> Any:
        return np.array([elements() for _ in range(made.steps)])

    made.gate = series(lambda: draw(st.integers(0, 3)))
    made.cost_env = series(lambda: draw(st.sampled_from([0, 0, 3])))
    made.a = series(lambda: draw(st.sampled_from([[0.5, -0.25], [0.0, 0.0], [-1.0, 1.0]])))
    for name in ("g_cost", "g_return", "delta_g", "signal"):
        setattr(made, name, series(lambda: draw(numbers)))
    steps, iterations = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    planned, searched = (series(lambda: draw(st.booleans())).astype(bool) for _ in range(2))
    searched &= planned
    made.plans = Plans(
        residuals=np.where(
            planned[:, None, None],
            draw(st.sampled_from([0.0, 0.5])),
            np.full((made.steps, steps, 2), NAN),
        ),
        safe=np.where(
            searched[:, None], draw(st.integers(0, 30)), np.full((made.steps, iterations), -1)
        ),
        case2=np.broadcast_to(searched[:, None], (made.steps, iterations)) & draw(st.booleans()),
        cost=series(lambda: draw(numbers)),
        reward=series(lambda: draw(numbers)),
        alone_cost=series(lambda: draw(numbers)),
        alone_reward=series(lambda: draw(numbers)),
    )
    return made


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(made=cells(), manifest=st.booleans(), width=st.integers(30, 140))
def test_every_cell_can_be_explained(made: Invented, manifest: bool, width: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        episode = made.read(Path(folder), manifest)
    text = text_of(episode_lines(episode, width))
    json.dumps(episode_json(episode), allow_nan=False)
    assert "nan" not in text.split()
    for most in (1, 3):
        pieces = merged_runs(episode, most)
        assert len(pieces) <= most
        assert [run.first for run in pieces[1:]] == [run.last + 1 for run in pieces[:-1]]
        assert (pieces[0].first, pieces[-1].last) == (0, episode.decisions - 1)
        for name in ("cost", "intervened"):
            assert sum(getattr(run, name) for run in pieces) == sum(
                getattr(run, name) for run in runs_of(episode)
            )
        assert tuple(t for run in pieces for t in run.missed) == places_of(episode.missed)
    for t in range(episode.decisions):
        assert decision_lines(episode, t, width)
        json.dumps(decision_json(episode, t), allow_nan=False)


# `wasp explain` from outside.


def wasp(*arguments: str | Path, code: int | None = None) -> Result:
    return run_here(*arguments, columns=200, code=code)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = Invented()
    made.fire(2, GATE_SAFETY)
    folder = tmp_path_factory.mktemp("explain") / "results"
    made.store(folder)
    return folder


def test_the_command_by_key_label_and_path(results: Path) -> None:
    folder = results / "store" / "evaluate" / KEY
    said = [
        wasp("explain", cell, "-e", "0", "--results", results)
        for cell in ("0123", "goal1 s0 wasp laggy=0.7", str(folder))
    ]
    browser = f"in a browser: wasp view {results} --page /cell/01234567/episode/0\n"
    assert {(done.exit_code, done.stderr) for done in said} == {(0, browser)}
    assert len({done.stdout for done in said}) == 1
    hint = f"one decision in full: wasp explain 01234567 --results {results} --episode 0 --step 2\n"
    assert said[0].stdout.endswith(hint)
    done = wasp(*hint.split()[5:], "--json")
    assert json.loads(done.stdout)["plan"]["safe"] == [3, 12, 30]
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["0123", "-e", "3"], "this cell has the episodes 0 to 2"),
        (["0123", "-e", "0", "-s", "8"], "episode 0 has the decisions 0 to 7"),
        (["goal1 s0 wasp lagy=0.7", "-e", "0"], "did you mean 'goal1 s0 wasp laggy=0.7'?"),
        (["../../x", "-e", "0"], "no evaluation '../../x'"),
        (["0123"], "Missing option"),
    ],
)
def test_wrong_usage_of_the_command_ends_with_2(
    arguments: list[str], expected: str, results: Path
) -> None:
    done = wasp("explain", *arguments, "--results", results)
    assert (done.exit_code, done.stdout) == (2, "")
    assert expected in done.stderr


def test_rows_that_cannot_be_read_end_with_1(results: Path, tmp_path: Path) -> None:
    path = tmp_path / "cell.parquet"
    path.write_bytes(b"PAR1 no table")
    assert "is damaged or was cut off" in wasp("explain", path, "-e", "0", code=1).stderr
