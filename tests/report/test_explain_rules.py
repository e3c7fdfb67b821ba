"""Methods that decide by a rule of their own, as `wasp explain` tells it."""

from __future__ import annotations

from pathlib import Path

from tests.report.explained import Invented, looked, told
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.report.explain.tell import tell
from wasp_cli.store.tables import Thresholds


def test_a_method_that_votes(tmp_path: Path) -> None:
    made = Invented(method="ida", thresholds=Thresholds(tau_q=0.1), config={"vote": 0.99})
    made.signal[:] = -0.2
    made.signal[3], made.gate[3], made.a[3] = 1.0, GATE_METHOD, [0.0, 0.0]
    made.pay(3, 4)
    episode = made.read(tmp_path)
    text = looked(episode, 3)
    assert "1.000, on a scale from -1 (no member of the ensemble prefers the copilot's action by more than τ_Q) to 1" in text
    assert "(τ_Q = 0.100); IDA intervenes above 0.990: it intervened" in text
    assert "The plan" not in text
    assert "safety gate" not in text
    assert "the command stood" in looked(episode, 4)
    story = told(episode)
    assert "IDA 12.5%, silent 87.5% of decisions" in story
    assert tell(episode).totals.missed == (4,)
    assert "  3          IDA   1 of 1, by 0.56  (+0.50, -0.25) → (+0.00, +0.00)   1.000     2  -" in story


def test_a_filter_has_a_threshold_of_cost_and_none_of_the_gates(tmp_path: Path) -> None:
    made = Invented(method="filter", thresholds=Thresholds(tau_c=0.4), config={})
    made.signal[:] = 0.1
    made.signal[3], made.gate[3], made.a[3] = 0.7, GATE_METHOD, [0.0, 0.0]
    made.pay(3, 4)
    episode = made.read(tmp_path)
    assert not episode.gated
    assert "Q_c             0.700, costly decisions to be expected of the command, discounted" in looked(episode, 3)
    assert "Safety filter intervenes above 0.400: it intervened" in " ".join(looked(episode, 3).split())
    assert "the command stood" in looked(episode, 4)
    story = told(episode)
    assert "Safety filter 12.5%, silent 87.5% of decisions" in story
    assert "safety gate" not in story + looked(episode, 3)
    assert "looks one imagined step ahead" in story
    assert tell(episode).totals.missed == (4,)
