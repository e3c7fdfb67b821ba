from __future__ import annotations

import time

from wasp_cli.drive.clock import Clock, Decider
from wasp_cli.store.people import percentiles


def test_an_answer_in_time_is_taken_and_a_late_one_is_not() -> None:
    decider: Decider[str] = Decider()
    try:
        assert decider.ask(lambda: "soon", time.monotonic() + 5.0)[0] == "soon"
        begun = time.monotonic()
        answer, seconds = decider.ask(lambda: _after(0.5, "late"), begun + 0.05)
        assert answer is None
        assert 0.04 < seconds < 0.4
        # While it is still being thought about, nothing new is asked, and what is thought about is never taken for the new answer.
        assert decider.ask(lambda: "new", time.monotonic() + 0.05)[0] is None
        assert decider.ask(lambda: "new", time.monotonic() + 5.0)[0] == "new"
        assert len(decider.seconds) == 3
        assert 0.5 <= max(decider.seconds) < 2.0
    finally:
        decider.close()


def _after(seconds: float, answer: str) -> str:
    time.sleep(seconds)
    return answer


def test_a_slow_beat_moves_the_later_ones_instead_of_skipping_them() -> None:
    clock = Clock(0.1)
    clock.begin()
    _, behind = clock.beat()
    assert behind < 0.05
    time.sleep(0.25)
    begun, behind = clock.beat()
    assert 0.1 < behind < 0.5
    assert abs(clock.due - (begun + 0.1)) < 1e-6, "the next one is a whole period away"


def test_the_deadline_leaves_time_for_everything_else() -> None:
    clock = Clock(0.1)
    clock.begin()
    begun, _ = clock.beat()
    assert begun < clock.deadline() < clock.due
    for _ in range(50):
        clock.spent(0.03)
    assert abs(clock.due - clock.deadline() - 0.03) < 1e-6


def test_percentiles_leave_out_what_is_unknown() -> None:
    assert percentiles([1.0, float("nan"), 3.0])[0] == 2.0
    assert all(value != value for value in percentiles([]))
