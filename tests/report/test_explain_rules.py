"""Other rules, the other WASPs, late assistants and searches that were cut off, as `wasp explain` tells them."""

from pathlib import Path

import numpy as np
import pytest

from tests.report.explained import NAN, PRINTED, Invented, decision_text, episode_text
from wasp_cli.metrics.episode import CUT_OFF, GATE_LATE, GATE_METHOD, GATE_SAFETY, GATE_TASK, episode_metrics
from wasp_cli.report.explain.episode import Episode, timeline
from wasp_cli.report.explain.facts import episode_json, places_of
from wasp_cli.store.tables import Thresholds


def test_a_method_that_votes(tmp_path: Path) -> None:
    made = Invented(method="ida", thresholds=Thresholds(tau_q=0.1), config={"vote": 0.99})
    made.signal[:] = -0.2
    made.signal[3], made.gate[3], made.a[3] = 1.0, GATE_METHOD, [0.0, 0.0]
    made.pay(3, 4)
    episode = made.read(tmp_path)
    text = decision_text(episode, 3)
    assert "  signal  value  threshold    τ_Q  intervenes\n  vote    1.000      0.990  0.100  yes\n" in text
    assert "vote: on a scale from -1 (no member of the ensemble prefers the copilot's action by more than τ_Q) to 1" in text
    assert "IDA intervened: the command was changed by" in text
    assert "Plan\n" not in text
    assert "safety gate" not in text
    assert "The command was executed." in decision_text(episode, 4)
    summary = episode_text(episode)
    assert "  IDA   vote > 0.990          1  12.5%\n  none  -                     7  87.5%\n" in summary
    assert places_of(episode.missed) == (4,)
    assert "  3          IDA   1 of 1, by 0.56  (+0.50, -0.25) → (+0.00, +0.00)   1.000     2          -" in summary


def test_a_filter_has_a_threshold_of_cost_and_none_of_the_gates(tmp_path: Path) -> None:
    made = Invented(method="filter", thresholds=Thresholds(tau_c=0.4), config={})
    made.signal[:] = 0.1
    made.signal[3], made.gate[3], made.a[3] = 0.7, GATE_METHOD, [0.0, 0.0]
    made.pay(3, 4)
    episode = made.read(tmp_path)
    assert not episode.gated
    assert "  signal  value  threshold  intervenes\n  Q_c     0.700      0.400  yes\n" in decision_text(episode, 3)
    assert "Q_c: costly decisions to be expected of the command, discounted" in decision_text(episode, 3)
    assert "The command was executed." in decision_text(episode, 4)
    summary = episode_text(episode)
    assert "  Safety filter  Q_c > 0.400          1  12.5%\n" in summary
    assert "safety gate" not in summary + decision_text(episode, 3)
    assert "looks one imagined step ahead" in summary
    assert places_of(episode.missed) == (4,)


def test_the_printed_wasp_probes_and_imagines_the_operator(tmp_path: Path) -> None:
    made = Invented(method="printed", config=dict(PRINTED))
    made.fire(2, GATE_SAFETY)
    made.fire(6, GATE_TASK, safe=(12, 25, 30))
    episode = made.read(tmp_path)
    text = decision_text(episode, 6)
    assert "ΔG: expected gain in return by the best safe correction of 20 that are tried" in text
    assert "expected discounted cost if the operator goes on alone, with the critic beyond the horizon" in text
    assert "\n  2                    25  I\n" in text
    text = decision_text(episode, 2)
    assert "  task    ΔG -       τ_r 0.500  not asked: the safety gate fired" in text
    assert "  commands alone            0.600" in text
    assert "other rollouts" not in text, "it plans on the rollouts of its gates"


@pytest.fixture
def late(tmp_path: Path) -> Episode:
    """Late three times, two of them with cost; one cost was missed, one paid although a gate fired."""
    made = Invented()
    made.fire(2, GATE_SAFETY)
    for t in (4, 5, 6):
        made.gate[t], made.g_cost[t], made.g_return[t], made.delta_g[t] = GATE_LATE, NAN, NAN, NAN
    made.pay(1, 2, 4, 6)
    return made.read(tmp_path)


def test_late_is_not_missed(late: Episode) -> None:
    text = " ".join(episode_text(late).split())
    assert "4 decisions with cost, 1 of them missed (no gate fired), 2 while the assistant was late." in text
    assert "1 missed, 1 although a gate fired, 2 while the assistant was late" in text
    assert "late no answer in time 3 37.5%" in text
    assert "no gate was asked" in text
    assert (places_of(late.missed), places_of(late.late)) == ((1,), (4, 6))
    assert episode_json(late)["totals"]["gate_share"]["late"] == 3 / 8


def test_a_late_decision_asked_no_gate(late: Episode) -> None:
    text = decision_text(late, 4)
    assert "The assistant had not answered in time: the command was executed." in text
    assert text.count("not asked: the assistant was late") == 2
    assert "search  none: the assistant was late" in text
    assert "no gate fired" not in text.lower()


def test_the_timeline_shows_them(late: Episode) -> None:
    acts = next(lane for lane in timeline(late) if lane.name == "acts")
    assert acts.marks == [("safety", 2, 1), ("late", 4, 3)]


def test_a_method_that_always_intervenes_misses_nothing_where_it_is_late(tmp_path: Path) -> None:
    made = Invented(method="saferl", config={}, thresholds=Thresholds())
    made.gate[:] = 3
    made.gate[4] = GATE_LATE
    made.pay(1, 4)
    assert not made.read(tmp_path).selective


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
