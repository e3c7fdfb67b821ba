from __future__ import annotations

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import wasp_cli.tasks.gym
from wasp_cli.errors import TaskError, UsageError

ID = "wasp/SafetyPointGoal1-v0"


@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value is.*")
@pytest.mark.parametrize("observation", ["state", "pixels", "privileged"])
def test_gymnasium_accepts_it(observation):
    env = gymnasium.make(ID, observation=observation, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_make_by_module_name_needs_no_import():
    code = f"import gymnasium; e = gymnasium.make('wasp_cli.tasks.gym:{ID}'); print(e.reset(seed=0)[0].shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(60,)"


def test_registration_leaves_mujoco_alone():
    code = "import sys, wasp_cli, wasp_cli.tasks.gym; print('mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_an_episode_ends_by_truncation_with_its_cost_in_info():
    env = gymnasium.make(ID, action_repeat=50)
    env.reset(seed=1)
    lengths, costs = 0, 0.0
    truncated = False
    while not truncated:
        _, _, terminated, truncated, info = env.step(np.array([1.0, 0.3]))
        assert not terminated
        assert info["cost"] == sum(info["cost_sources"].values())
        assert {"cost", "cost_sources", "goals", "success"} == info.keys()
        lengths, costs = lengths + 1, costs + info["cost"]
    assert lengths == 20
    with pytest.raises(TaskError, match="after the end"):
        env.step(np.array([0.0, 0.0]))


def test_seeds_name_episodes():
    env = gymnasium.make(ID, observation="privileged")
    first, second = env.reset(seed=4)[0], env.reset()[0]
    assert (first == env.reset(seed=4)[0]).all()
    assert (second == env.reset()[0]).all()
    assert (first != second).any()


def test_success_counts_goals(monkeypatch):
    env = wasp_cli.tasks.gym.TaskEnv("goal1", "privileged")
    env.reset(seed=0)
    env._goals = 7
    assert env.step(np.zeros(2))[4]["success"]
    env.reset(seed=0)
    assert not env.step(np.zeros(2))[4]["success"]


def test_rendering():
    env = gymnasium.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (256, 256, 3)
    assert picture.dtype == np.uint8
    assert env.metadata["render_fps"] == 50
    with pytest.raises(UsageError, match="cannot render"):
        wasp_cli.tasks.gym.TaskEnv("goal1", render_mode="human")
    assert wasp_cli.tasks.gym.TaskEnv("goal1").render() is None
