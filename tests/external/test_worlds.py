"""The worlds are those of the authors: where goals are, who sees them, what ends an episode."""

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env

from tests.external.assistants import candidates, votes
from tests.external.flights import alone
from tests.external.lander import CRASHED, REACHED, SEEN, STEPS, GoalLander, Kind
from tests.external.pilots import build
from tests.external.task import LanderTask

KINDS: tuple[Kind, ...] = ("lander", "reacher")
AHEAD, NOTHING = np.array([1.0, 0.0], np.float32), np.zeros(2, np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_an_environment(kind):
    check_env(GoalLander(kind))


def test_pads_have_nine_places_and_ground_that_is_flat():
    world = GoalLander("lander")
    goals = {round(float(world.reset(seed=seed)[0][SEEN]), 3) for seed in range(120)}
    assert goals == {round(float(goal), 3) for goal in candidates("lander").flatten()}
    heights = [edge.shape.vertices for edge in world.physics.moon.fixtures[:-1]]
    on_pad = [
        y
        for edge in heights
        for x, y in edge
        if world.physics.helipad_x1 <= x <= world.physics.helipad_x2
    ]
    assert np.ptp(on_pad) < 0.1


def test_targets_are_above_and_beside_the_middle():
    world = GoalLander("reacher")
    goals = np.array([world.reset(seed=seed)[0][SEEN:] for seed in range(200)])
    assert (np.abs(goals[:, 0]) >= 0.5 - 1e-6).all()
    assert (np.sign(goals[:, 0]) > 0).mean() == pytest.approx(0.5, abs=0.15)
    assert goals[:, 1].min() > 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_is_the_same_world_and_the_assistant_does_not_see_its_goal(kind):
    first, again, other = (LanderTask(kind, 1).reset([seed]) for seed in (5, 5, 6))
    assert (first.privileged == again.privileged).all()
    assert (first.privileged != other.privileged).any()
    assert first.state.shape == (1, SEEN)


def test_falling_is_a_crash_and_the_target_ends_the_other_world():
    for kind in KINDS:
        world = GoalLander(kind)
        world.reset(seed=0)
        ended = False
        while not ended:
            _, reward, ended, _, info = world.step(NOTHING)
        assert (reward, info["crashed"], info["reached"]) == (CRASHED, True, False)
    world = GoalLander("reacher")
    world.reset(seed=0)
    world.target = tuple(world.physics.lander.position)
    _, reward, ended, _, info = world.step(NOTHING)
    assert (reward, ended, info["reached"]) == (REACHED, True, True)


def test_a_landing_counts_on_the_pad_alone():
    for place, reached in ((0.0, True), (6.0, False)):
        world = GoalLander("lander")
        world.reset(seed=3)
        world.physics.helipad_x1, world.physics.helipad_x2 = (
            place + world.physics.lander.position.x + d for d in (-2.0, 2.0)
        )
        world.physics.lander.awake = False
        world.physics.world.gravity = (0, 0)
        for body in (world.physics.lander, *world.physics.legs):
            body.awake = False
        _, _, ended, _, info = world.step(NOTHING)
        assert (ended, info["reached"], info["crashed"]) == (True, reached, False)


def test_the_reward_without_a_goal_is_the_one_of_gymnasium():
    """With the pad in the middle the shaping is the same, but for the height at which a lander
    stands.
    """
    world, original = GoalLander("lander"), gymnasium.make("LunarLanderContinuous-v3")
    world.reset(seed=0)
    original.reset(seed=0)
    world.physics.reset(seed=0)
    world.physics.helipad_x1, world.physics.helipad_x2 = 8.0, 12.0
    world.target = (10.0, world.target[1])
    world.step(NOTHING)
    original.step(NOTHING)
    for action in np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32):
        seen, reward, *_ = world.step(action)
        expected, wanted, *_ = original.step(action)
        assert seen[:SEEN] == pytest.approx(expected)
        assert reward == pytest.approx(float(wanted), abs=1e-3)


def test_time_ends_an_episode_that_goes_nowhere():
    loop = alone("lander", "zero", lambda observation: torch.zeros(len(observation), 2), range(4))
    assert loop.cost.any(0).all()
    world = GoalLander("reacher")
    world.reset(seed=0)
    world.steps = STEPS - 1
    assert world.step(AHEAD)[3]


@pytest.mark.parametrize("kind", KINDS)
def test_pilots_see_the_goal(kind):
    task = LanderTask(kind, 3)
    seen = task.reset([0, 1, 2])
    expert = build(
        kind, "expert", lambda observation: observation[:, SEEN:].repeat(1, 2)[:, :2], [0, 1, 2]
    )
    command = expert.command(torch.zeros(3, SEEN), torch.from_numpy(seen.privileged))
    assert torch.equal(command[:, 0], torch.from_numpy(seen.privileged)[:, SEEN])


@pytest.mark.parametrize("kind", KINDS)
def test_members_of_the_vote_are_the_experts_critic_at_each_goal(kind):
    model = SAC(
        "MlpPolicy",
        GoalLander(kind),
        policy_kwargs={"net_arch": [16, 16]},
        seed=0,
        device="cpu",
        buffer_size=10,
    )
    goals, seen, action = candidates(kind), torch.randn(5, SEEN), torch.rand(5, 2) * 2 - 1
    found = votes(model, goals)(seen, action)
    assert found.shape == (len(goals), 5)
    for member, goal in zip(found, goals, strict=True):
        inputs = torch.cat([seen, goal.expand(5, -1), action], 1)
        assert torch.allclose(
            member, model.policy.critic.q_networks[0](inputs).squeeze(1), atol=1e-5
        )
