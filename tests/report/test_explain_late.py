"""Decisions at which the assistant of a person was late, and searches that were cut off, in the words of `wasp explain`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.report.explained import NAN, Invented, decision_text, episode_text
from wasp_cli.metrics.episode import CUT_OFF, GATE_LATE, GATE_SAFETY, episode_metrics
from wasp_cli.report.explain.facts import episode_json, places_of
from wasp_cli.report.explain.stored import Episode
from wasp_cli.report.explain.timeline import timeline
from wasp_cli.store.tables import Thresholds


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
