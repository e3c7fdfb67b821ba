"""TorchRL: the specs that it reads from the environments, and their costs in its tensors."""

import gymnasium
import pytest
from torchrl import envs

import wasp_cli.tasks.gym  # noqa: F401  # registers the ids
from tests.peers import IDS


@pytest.mark.parametrize("observation", ["state", "all", "vision"])
@pytest.mark.parametrize("name", IDS)
def test_its_wrapper_accepts_it(name, observation):
    envs.check_env_specs(envs.GymWrapper(gymnasium.make(name, observation=observation)))


@pytest.mark.parametrize("name", IDS)
def test_its_own_make_accepts_it(name):
    envs.check_env_specs(envs.GymEnv(name))
    # refused as an option, so that it repeats actions itself
    repeated = envs.GymEnv(f"wasp_cli.tasks.gym:{name}", frame_skip=2)
    assert repeated.wrapper_frame_skip == 2
    assert repeated.rollout(3).batch_size == (3,)


@pytest.mark.parametrize("name", IDS)
def test_its_reader_finds_the_costs(name):
    env = envs.GymWrapper(gymnasium.make(name, action_repeat=10)).auto_register_info_dict()
    steps = env.rollout(20)
    sources = [key for key in steps["next"].keys() if key.startswith("cost_") and key != "cost_sum"]  # noqa: SIM118  # a TensorDict
    assert len(sources) == {"0": 0, "1": 2, "2": 3}[name[-4]] - ("PointGoal1" in name)
    assert (steps["next", "cost"] == steps["next", "cost_sum"]).all()
    for source in sources:
        assert (steps["next", source] <= steps["next", "cost"]).all()
    assert not steps["cost"][0].any()


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])  # it refuses NextStep
def test_it_wraps_the_vector(mode):
    env = envs.GymWrapper(
        gymnasium.make_vec(IDS[0], num_envs=3, action_repeat=100, autoreset_mode=mode)
    )
    envs.check_env_specs(env)
    steps = env.rollout(25, break_when_any_done=False)
    assert steps.batch_size == (3, 25)
    assert steps["next", "truncated"].sum() == 6
