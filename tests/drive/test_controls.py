from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.drive.controls import Controls
from wasp_cli.drive.desk import END, GO, KEYS, PAUSE, Desk, Held, action_of
from wasp_cli.errors import UsageError
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


@pytest.mark.parametrize(
    ("size", "keys", "action", "shown"),
    [
        (1, None, [-0.5], [0.0, 0.5]),
        (2, None, [0.25, 0.5], [0.25, 0.5]),
        (1, ("left",), [0.5], [0.0, 0.5]),
        (3, ("right", "none", "up"), [-0.5, 0.0, 0.25], [0.25, 0.5]),
        (2, ("up", "down"), [0.25, -0.25], [0.25, 0.0]),
    ],
)
def test_an_environment_of_others_gets_as_many_numbers_as_it_takes(size, keys, action, shown):
    controls = Controls(SimpleNamespace(action_size=size), keys)
    commanded = controls.action(np.array([0.25, 0.5], np.float32))
    assert commanded.dtype == np.float32
    assert commanded.tolist() == action
    assert controls.stick(commanded).tolist() == shown


def test_nobody_guesses_which_keys_command_three_numbers():
    with pytest.raises(UsageError, match="3 numbers"):
        Controls(SimpleNamespace(action_size=3))


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
