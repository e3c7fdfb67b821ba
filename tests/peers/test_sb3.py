"""stable-baselines3: its checker, and PPO on single environments and in processes."""

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor

import wasp_cli.tasks.gym  # noqa: F401  # registers the ids
from tests.peers import IDS


@pytest.mark.filterwarnings(
    "ignore:.*We recommend you to use|.*action space has dtype float64:UserWarning"
)
@pytest.mark.parametrize("observation", ["state", "pixels", "privileged", "all", "vision"])
@pytest.mark.parametrize("name", IDS)
def test_the_checker_accepts_it(name, observation):
    check_env(gymnasium.make(name, observation=observation))


def test_ppo_learns_on_it():
    env = Monitor(
        gymnasium.make(IDS[0], observation="privileged", action_repeat=10),
        info_keywords=("cost", "goals"),
    )
    model = PPO("MlpPolicy", env, n_steps=200, batch_size=100, seed=0, device="cpu")
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    model.learn(1000)
    assert any((tensor != before[name]).any() for name, tensor in model.policy.state_dict().items())
    assert [episode["l"] for episode in model.ep_info_buffer] == [100] * 10
    assert {"cost", "goals"} <= model.ep_info_buffer[0].keys()
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action.astype(np.float64))


def test_its_vectors_step_it():
    envs = make_vec_env(IDS[0], n_envs=2, seed=0, env_kwargs={"action_repeat": 250})
    assert envs.reset().shape == (2, 60)
    for _ in range(4):
        _, _, done, infos = envs.step(np.zeros((2, 2)))
    assert done.all()
    assert all(
        info["TimeLimit.truncated"] and info["terminal_observation"].shape == (60,)
        for info in infos
    )
