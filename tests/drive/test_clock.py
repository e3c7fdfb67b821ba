from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from wasp_cli.drive import desk as module
from wasp_cli.drive.check import recommended
from wasp_cli.drive.desk import Clock, Decider
from wasp_cli.store.people import percentiles


@pytest.fixture
def decider() -> Iterator[Decider[Any]]:
    made: Decider[Any] = Decider()
    yield made
    made.close()


def test_an_answer_in_time_is_taken_and_a_late_one_is_not(decider: Decider[str]) -> None:
    assert decider.ask(lambda: "soon", 600.0)[0] == "soon"
    told = threading.Event()
    answer, seconds = decider.ask(lambda: "late" if told.wait(600.0) else "never", 0.05)
    assert answer is None
    assert seconds > 0.04
    # While it is still being thought about, nothing new is asked, and what is thought about is
    # never taken for the new answer.
    assert decider.ask(lambda: "new", 0.05)[0] is None
    told.set()
    assert decider.ask(lambda: "new", 600.0)[0] == "new"
    assert [(late, answer) for _, late, answer in decider.answers] == [
        (False, "soon"),
        (True, "late"),
        (False, "new"),
    ]


def test_an_assistant_whose_beat_is_over_has_its_time_nevertheless(decider: Decider[str]) -> None:
    """On a busy machine everything else once took up the whole period, and left less than 5 ms."""
    clock = Clock(0.1)
    for _ in range(50):
        clock.spent(0.5)
    clock.beat()
    assert decider.ask(lambda: time.sleep(0.05) or "there", 600.0, clock.deadline())[0] == "there"


class Hands:
    """The hands of a clock that a test moves."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def hands(monkeypatch: pytest.MonkeyPatch) -> Hands:
    made = Hands()
    monkeypatch.setattr(module, "time", made)
    return made


def test_a_search_is_told_when_its_time_is_up(decider: Decider[list[bool]], hands: Hands) -> None:
    def searches() -> list[bool]:
        found = [decider.time_is_up()]
        hands.now += 0.3
        return [*found, decider.time_is_up()]

    # Another step of 0.3 s would end after the 0.4 s that it has at least, one of no time before
    # them.
    assert decider.ask(searches, 600.0, hands.now, 0.4)[0] == [False, True]
    assert decider.ask(searches, 600.0, hands.now + 20.0)[0] == [False, False]


def test_what_goes_wrong_in_a_late_answer_is_told(decider: Decider[None]) -> None:
    def fails() -> None:
        time.sleep(0.1)
        raise ValueError("it went wrong")

    assert decider.ask(fails, 0.01)[0] is None
    with pytest.raises(ValueError, match="it went wrong"):
        decider.ask(fails, 600.0)


def test_a_slow_beat_moves_the_later_ones_instead_of_skipping_them(hands: Hands) -> None:
    clock = Clock(0.1)
    assert clock.beat() == (hands.now, 0.0)
    hands.now += 0.25
    begun, behind = clock.beat()
    assert behind == pytest.approx(0.15)
    assert abs(clock.due - (begun + 0.1)) < 1e-6, "the next one is a whole period away"


def test_the_deadline_leaves_time_for_everything_else(hands: Hands) -> None:
    clock = Clock(0.1)
    begun, _ = clock.beat()
    assert begun < clock.deadline() < clock.due
    for _ in range(50):
        clock.spent(0.03)
    assert abs(clock.due - clock.deadline() - 0.03) < 1e-6


def test_a_world_that_slowed_down_is_driven_slower() -> None:
    rest = np.array([0.03] * 80 + [0.15] * 20)
    driven: Any = SimpleNamespace(
        beats=[SimpleNamespace(rest_ms=1000 * seconds) for seconds in rest]
    )
    assert recommended([0.01] * 100, [], driven, 0.08, 1.0, [0.08] * 100) == 1.0
    assert (
        recommended([0.01] * 100, [], driven, 0.08, 1.0, np.maximum(0.08, 0.01 + rest).tolist())
        == 0.6
    )


def test_percentiles_leave_out_what_is_unknown() -> None:
    assert percentiles([1.0, float("nan"), 3.0])[0] == 2.0
    assert all(value != value for value in percentiles([]))
