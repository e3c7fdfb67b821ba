from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.drive.desk import END, GO, KEYS, PAUSE, Desk, Held, action_of
from wasp_cli.video.map import stick

UNIT = st.floats(-1.0, 1.0, width=32)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ((), (0, 0)),
        (("KeyW", "ArrowUp"), (1, 0)),
        (("KeyS", "KeyD"), (-1, -1)),
        (("ArrowUp", "ArrowDown", "KeyA"), (0, 1)),
    ],
)
def test_keys_are_a_stick(keys: tuple[str, ...], expected: tuple[float, float]) -> None:
    assert Held(frozenset(keys)).stick.tolist() == list(expected)


@given(st.sets(st.sampled_from(sorted(KEYS))), UNIT, UNIT)
def test_a_stick_stays_within_its_bounds(keys: set[str], forward: float, left: float) -> None:
    assert np.abs(Held(frozenset(keys), (forward, left)).stick).max() <= 1.0


@given(UNIT, UNIT, st.sampled_from(["point", "car"]))
def test_the_action_drives_as_the_stick_says(forward: float, left: float, drive: str) -> None:
    """A film draws an action as the stick that it came from, as far as the wheels reach."""
    action = action_of(np.array([forward, left], np.float32), drive)
    assert np.abs(action).max() <= 1.0
    if drive == "point" or abs(forward) + abs(left) <= 1.0:
        np.testing.assert_allclose(
            stick(SimpleNamespace(drive=drive), action.astype(np.float64)),
            [forward, left],
            atol=1e-6,
        )


def test_only_the_latest_state_counts_and_a_release_lets_go_of_everything() -> None:
    desk = Desk()
    desk.come()
    desk.hold(frozenset({"ArrowUp"}), (0.0, 0.0), 1)
    desk.hold(frozenset({"ArrowLeft", "KeyQ"}), (0.5, 0.0), 2)
    assert (desk.held.keys, desk.held.axes, desk.held.number) == (
        frozenset({"ArrowLeft"}),
        (0.5, 0.0),
        2,
    )
    assert desk.asked() is None
    desk.focus(False)
    assert (desk.held.keys, desk.held.axes, desk.held.number) == (frozenset(), (0.0, 0.0), 2)
    desk.hold(frozenset(), (0.7, 0.0), 3)
    assert desk.held.axes == (0.0, 0.0), "a gamepad says something without the window's focus too"
    assert desk.asked() == PAUSE
    threading.Timer(0.1, desk.ask, (END,)).start()
    desk.ask(GO)
    assert desk.wait() == END
