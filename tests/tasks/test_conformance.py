"""The tasks against recordings of the reference package."""

import gymnasium
import numpy as np
import pytest

from tests.conformance import __main__ as conformance
from tests.conformance.comparison import compare
from tests.tasks.conftest import DATA, load_recording
from tests.tasks.test_gym import ID, text
from wasp_cli.errors import UnknownName, UnknownOption, UsageError
from wasp_cli.tasks import sheet
from wasp_cli.tasks.gym import upstream
from wasp_cli.tasks.sheet import draw_sheet

RECORDINGS = sorted(path.name for path in DATA.glob("*.npz"))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * ("Formula" in name)) for name in RECORDINGS],
)
def test_every_quantity_of_a_recording_is_within_tolerance(name):
    recording = load_recording(name)
    assert [each for each in conformance.checks_of(recording)(recording) if not each.ok] == []


def test_the_recordings_have_what_makes_the_checks_mean_something():
    goal, race, formula = (
        load_recording(name)
        for name in ("PointGoal1_seed0.npz", "CarRace1_seed0.npz", "CarFormulaOne1_seed1.npz")
    )
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
        pytest.param(
            "CarRace1_seed0.npz", "layout_hazards_xy", lambda a: a + 1e-9, marks=pytest.mark.slow
        ),
        pytest.param(
            "CarRace1_seed0.npz",
            "n_static_contacts",
            lambda a: np.ones_like(a),
            marks=pytest.mark.slow,
        ),
        pytest.param("CarRace1_seed0.npz", "obs", lambda a: a + 1e-3, marks=pytest.mark.slow),
        pytest.param("CarFormulaOne1_seed1.npz", "goal_met", lambda a: ~a, marks=pytest.mark.slow),
        pytest.param(
            "CarFormulaOne1_seed1.npz",
            "n_vase_contacts",
            lambda a: np.roll(a, 60),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "CarFormulaOne1_seed1.npz", "state_qvel", lambda a: a * 1.01, marks=pytest.mark.slow
        ),
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
        pytest.param(
            "PointGoal1_seed0.npz",
            "goal.task.Goal.num_steps",
            600,
            "meta num_steps",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "PointGoal1_seed0.npz",
            "goal.task.VASE_KEEPOUT",
            0.16,
            "layout vases_xy",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "CarRace1_seed0.npz",
            "race.task.Race.reward_goal",
            9.0,
            "reward, all steps",
            marks=pytest.mark.slow,
        ),
        ("CarRace1_seed0.npz", "race.task.HAZARD_RADIUS", 0.27, "cost_hazards"),
        pytest.param(
            "CarRace1_seed0.npz",
            "car.REACH",
            0.0,
            "cost of walls as the gaps tell",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "CarRace1_seed0.npz",
            "navigation.Navigation.goal_radius",
            0.31,
            "meta goal_size",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "CarFormulaOne1_seed1.npz",
            "formula.task.Formula.num_steps",
            750,
            "meta num_steps",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "CarFormulaOne1_seed1.npz",
            "formula.task.BARREL_KEEPOUT",
            0.49,
            "layout vases_xy",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "CarFormulaOne1_seed1.npz",
            "formula.task._REACH",
            0.0,
            "first contact with a barrel",
            marks=pytest.mark.slow,
        ),
        ("CarRace1_seed0.npz", "features.RANGE", 2.9, "hazards_lidar"),
    ],
)
def test_a_wrong_task_is_noticed(name, place, value, noticed_by, monkeypatch):
    monkeypatch.setattr(f"wasp_cli.tasks.{place}", value)
    recording = load_recording(name)
    assert noticed_by in [
        each.quantity for each in conformance.checks_of(recording)(recording) if not each.ok
    ]


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


# The reference package's interface: six values, its ids and its options.


def test_upstream_gives_six_values_and_its_keys(monkeypatch):
    env, usual = (
        upstream("SafetyPointGoal1-v0", action_repeat=10),
        gymnasium.make(ID, action_repeat=10),
    )
    first, nothing = env.reset(seed=9)
    assert text(first) == text(usual.reset(seed=9)[0])
    assert nothing == {"cost_hazards": 0.0, "cost_sum": 0.0}
    costs = 0.0
    for _ in range(100):
        action = np.array([1.0, 0.1])  # through a hazard
        observation, reward, cost, terminated, truncated, info = env.step(action)
        expected = usual.step(action)
        assert text(observation) == text(expected[0])
        assert (reward, terminated, truncated) == expected[1:4]
        assert cost == info["cost_sum"] == expected[4]["cost"]
        assert info.keys() - {"goal_met"} == {"cost_sum", "cost_hazards"}
        costs += cost
    assert truncated
    assert costs > 0
    env.reset(seed=0)
    assert "goal_met" not in env.step(np.zeros(2))[5]
    task = env.unwrapped._task
    real = task.step
    monkeypatch.setattr(task, "step", lambda action: real(action)._replace(goals=np.array([1])))
    assert env.step(np.zeros(2))[5]["goal_met"] is True


BODY = ["accelerometer", "velocimeter", "gyro", "magnetometer"]
CASTER = ["ballangvel_rear", "ballquat_rear"]


@pytest.mark.parametrize(
    ("name", "sensors"),
    [
        ("SafetyPointGoal1", [*BODY, "goal_lidar", "hazards_lidar", "vases_lidar"]),
        ("SafetyPointGoal0", [*BODY, "goal_lidar"]),
        ("SafetyCarRace1", [*BODY, *CASTER, "goal_lidar", "hazards_lidar"]),
        ("SafetyCarFormulaOne1", [*BODY, *CASTER, "staged_goal_lidar", "vases_lidar"]),
    ],
)
def test_upstream_takes_vision_ids(name, sensors):
    env, plain = upstream(f"{name}Vision-v0"), gymnasium.make(f"wasp/{name}-v0", observation="all")
    image, _ = env.reset(seed=3)
    everything, _ = plain.reset(seed=3)
    assert list(image) == [*sensors, "vision"]
    assert env.observation_space.contains(image)
    assert (
        np.concatenate([image[name].ravel() for name in sensors]).tobytes()
        == everything["state"].tobytes()
    )
    assert (image["vision"] == np.moveaxis(everything["pixels"][:3], 0, -1)).all()
    assert len(env.step(np.zeros(2))) == 6


def test_upstream_says_what_it_does_not_have():
    options = (
        "autoreset",
        "max_episode_steps",
        "camera_id",
        "camera_name",
        "config",
        "disable_env_checker",
        "apply_api_compatibility",
    )
    for option in options:
        with pytest.raises(UnknownOption, match=f"unexpected keyword argument '{option}'"):
            upstream("SafetyPointGoal1-v0", **{option: 1})
    for mode in ("human", "depth_array"):
        with pytest.raises(UsageError, match=f"cannot render '{mode}'"):
            upstream("SafetyPointGoal1-v0", render_mode=mode)
    with pytest.raises(UsageError, match="keyboard"):
        upstream("SafetyPointGoal1Debug-v0")
    for name in ("SafetyPointButton1Vision-v0", "SafetyPointGaol1-v0"):
        with pytest.raises(UnknownName, match=name) as caught:
            upstream(name)
    assert "wasp/SafetyPointGoal1-v0" in caught.value.hint


def test_the_folder_is_looked_for_before_anything_is_driven(tmp_path, monkeypatch):
    monkeypatch.setattr(sheet, "make_task", lambda *_, **__: pytest.fail("driven"))
    with pytest.raises(UsageError) as caught:
        draw_sheet("goal1", 0, tmp_path / "missing" / "x.png")
    assert caught.value.hint == f"create the folder '{tmp_path / 'missing'}'"
