"""The reference package's interface: six values, its ids and its options."""

import gymnasium
import numpy as np
import pytest

from tests.tasks.test_gym import ID, text
from wasp_cli.errors import UnknownName, UnknownOption, UsageError
from wasp_cli.tasks.gym import upstream


def test_upstream_gives_six_values_and_its_keys(monkeypatch):
    env, usual = upstream("SafetyPointGoal1-v0", action_repeat=10), gymnasium.make(ID, action_repeat=10)
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
    assert np.concatenate([image[name].ravel() for name in sensors]).tobytes() == everything["state"].tobytes()
    assert (image["vision"] == np.moveaxis(everything["pixels"][:3], 0, -1)).all()
    assert len(env.step(np.zeros(2))) == 6


def test_upstream_takes_gymnasium_ids():
    env = upstream(id="wasp/SafetyCarRace1VisionGymnasium-v0", max_episode_steps=7)
    assert env.spec.max_episode_steps == 7
    assert env.reset(seed=0)[0]["vision"].shape == (64, 64, 3)
    assert len(env.step(np.zeros(2))) == 5


def test_upstream_says_what_it_does_not_have():
    for option in (
        "autoreset",
        "max_episode_steps",
        "camera_id",
        "camera_name",
        "config",
        "disable_env_checker",
        "apply_api_compatibility",
    ):
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
