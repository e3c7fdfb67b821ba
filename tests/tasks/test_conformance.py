"""The tasks against recordings of the reference package."""

from functools import cache

import numpy as np
import pytest

from tests.conformance import __main__ as conformance
from tests.conformance.comparison import compare
from tests.tasks.conftest import DATA, load_recording

RECORDINGS = sorted(path.name for path in DATA.glob("*.npz"))


@cache
def compared(name):
    """What the tasks as they are make of a recording as it is."""
    recording = load_recording(name)
    check = conformance.checks_of(recording)
    assert check is not None
    return tuple(check(recording))


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_quantity_of_a_recording_is_within_tolerance(name):
    assert [each for each in compared(name) if not each.ok] == []


@pytest.mark.parametrize(
    ("name", "quantities"),
    [
        ("PointGoal1_seed0.npz", {"xy after one step", "reward, vase untouched", "cost", "goal, all steps", "hazards_lidar"}),
        ("CarRace1_seed0.npz", {"layout hazards_xy", "xy after one step, free", "gap to a wall that is touched", "cost_hazards"}),
        ("CarFormulaOne1_seed1.npz", {"layout vases_xy", "xy after one step, by barrels", "first contact with a barrel", "goal"}),
        ("dynamics.npz", {"point xy after one step", "car xy after one step", "car_rk4 mean speed / theirs"}),
    ],
)
def test_nothing_that_was_recorded_is_left_out(name, quantities):
    assert quantities <= {each.quantity for each in compared(name)}


def test_the_recordings_have_what_makes_the_checks_mean_something():
    goal, race, formula = (load_recording(name) for name in ("PointGoal1_seed0.npz", "CarRace1_seed0.npz", "CarFormulaOne1_seed1.npz"))
    assert goal["cost"].sum() > 10
    assert goal["goal_met"].sum() == 2
    assert goal["n_vase_contacts"].sum() > 10
    assert race["terminated"][-1]
    assert (race["n_static_contacts"] > 0).sum() > 30
    assert race["costs"][:, 0].sum() > 30
    assert formula["goal_met"].sum() == 1
    assert (formula["n_vase_contacts"] > 0).sum() > 10


@pytest.mark.parametrize(
    ("name", "field", "change"),
    [
        ("CarRace1_seed0.npz", "xy", lambda a: a + 2e-2),
        pytest.param("CarRace1_seed0.npz", "layout_hazards_xy", lambda a: a + 1e-9, marks=pytest.mark.slow),
        pytest.param("CarRace1_seed0.npz", "n_static_contacts", lambda a: np.ones_like(a), marks=pytest.mark.slow),
        pytest.param("CarRace1_seed0.npz", "obs", lambda a: a + 1e-3, marks=pytest.mark.slow),
        pytest.param("CarFormulaOne1_seed1.npz", "goal_met", lambda a: ~a, marks=pytest.mark.slow),
        pytest.param("CarFormulaOne1_seed1.npz", "n_vase_contacts", lambda a: np.roll(a, 60), marks=pytest.mark.slow),
        pytest.param("CarFormulaOne1_seed1.npz", "state_qvel", lambda a: a * 1.01, marks=pytest.mark.slow),
        ("dynamics.npz", "car_rk4_traj", lambda a: a * 1.1),
    ],
)
def test_a_wrong_recording_fails(name, field, change):
    recording = load_recording(name)
    recording[field] = change(recording[field])
    assert [each.quantity for each in conformance.checks_of(recording)(recording) if not each.ok]


@pytest.mark.parametrize(
    ("name", "place", "value", "noticed_by"),
    [
        ("PointGoal1_seed0.npz", "goal.task.Goal.reward_goal", 2.0, "reward, all steps"),
        pytest.param("PointGoal1_seed0.npz", "goal.task.Goal.num_steps", 600, "meta num_steps", marks=pytest.mark.slow),
        pytest.param("PointGoal1_seed0.npz", "goal.task.VASE_KEEPOUT", 0.16, "layout vases_xy", marks=pytest.mark.slow),
        pytest.param("CarRace1_seed0.npz", "race.task.Race.reward_goal", 9.0, "reward, all steps", marks=pytest.mark.slow),
        ("CarRace1_seed0.npz", "race.task.HAZARD_RADIUS", 0.27, "cost_hazards"),
        pytest.param("CarRace1_seed0.npz", "car.REACH", 0.0, "cost of walls as the gaps tell", marks=pytest.mark.slow),
        pytest.param("CarRace1_seed0.npz", "navigation.Navigation.goal_radius", 0.31, "meta goal_size", marks=pytest.mark.slow),
        pytest.param("CarFormulaOne1_seed1.npz", "formula.task.Formula.num_steps", 750, "meta num_steps", marks=pytest.mark.slow),
        pytest.param("CarFormulaOne1_seed1.npz", "formula.task.BARREL_KEEPOUT", 0.49, "layout vases_xy", marks=pytest.mark.slow),
        pytest.param("CarFormulaOne1_seed1.npz", "formula.task._REACH", 0.0, "first contact with a barrel", marks=pytest.mark.slow),
        ("CarRace1_seed0.npz", "features.RANGE", 2.9, "hazards_lidar"),
    ],
)
def test_a_wrong_task_is_noticed(name, place, value, noticed_by, monkeypatch):
    monkeypatch.setattr(f"wasp_cli.tasks.{place}", value)
    recording = load_recording(name)
    assert noticed_by in [each.quantity for each in conformance.checks_of(recording)(recording) if not each.ok]


def test_the_command_reports_fails_on_a_wrong_recording_and_skips_unknown_ones(tmp_path, capsys):
    right = load_recording("dynamics.npz")
    np.savez(tmp_path / "boat.npz", meta='{"task": "SafetyBoatGoal1-v0"}')
    for recording, code in ((right, 0), (right | {"car_rk4_traj": 1.1 * right["car_rk4_traj"]}, 1)):
        np.savez(tmp_path / "car.npz", **recording)
        assert conformance.main([str(tmp_path)]) == code
        out = capsys.readouterr().out
        assert ("FAILED" in out) == bool(code)
        assert "car.npz" in out
        assert "boat.npz                     skipped" in out
    assert conformance.main([]) == 2


def test_nan_is_out_of_tolerance():
    assert not compare("q", [np.nan], [0.0], 1.0).ok
    assert not compare("q", [], [], 1.0).ok
    with pytest.raises(ValueError, match="shapes"):
        compare("q", [1.0], [1.0, 2.0], 1.0)
