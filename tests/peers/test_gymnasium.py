"""gymnasium itself: its checker, its wrappers, its vectors in processes of their own."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import wasp_cli.tasks.gym  # noqa: F401  # registers the ids
from tests.peers import IDS


@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value is.*")
@pytest.mark.parametrize("name", IDS)
def test_the_checker_accepts_every_task(name):
    for observation in ("state", "vision"):
        check_env(gymnasium.make(name, observation=observation, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("mode", list(gymnasium.vector.AutoresetMode))
def test_vectors_in_processes_give_the_same_to_the_bit(mode):
    options: dict[str, Any] = {"action_repeat": 10, "max_episode_steps": 4}
    ours = gymnasium.make_vec(IDS[0], num_envs=2, autoreset_mode=mode, **options)
    theirs = gymnasium.make_vec(
        IDS[0],
        num_envs=2,
        vectorization_mode="async",
        vector_kwargs={"autoreset_mode": mode},
        **options,
    )
    try:
        for envs in (ours, theirs):
            envs.reset(seed=3)
        random = np.random.default_rng(0)
        for number in range(4 if mode is gymnasium.vector.AutoresetMode.DISABLED else 10):
            action = random.uniform(-1, 1, (2, 2))
            mine, others = ours.step(action), theirs.step(action)
            for one, other in zip(mine[:4], others[:4], strict=True):
                assert np.asarray(one).tobytes() == np.asarray(other).tobytes(), number
            assert mine[4].keys() == others[4].keys()
            assert mine[4]["cost"].tobytes() == others[4]["cost"].tobytes()
    finally:
        theirs.close()


def test_usual_wrappers_lie_around_it():
    wrappers = gymnasium.wrappers
    env: Any = gymnasium.make(
        IDS[0], action_repeat=100, render_mode="rgb_array", width=32, height=32
    )
    env = wrappers.RecordEpisodeStatistics(
        wrappers.TimeAwareObservation(wrappers.ClipAction(env), normalize_time=False)
    )
    env = wrappers.RenderCollection(wrappers.NormalizeObservation(env))
    seen, _ = env.reset(seed=0)
    assert seen.shape == (61,)
    for _ in range(10):
        *_, truncated, info = env.step(env.action_space.sample())
    assert truncated
    assert info["episode"]["l"] == 10
    assert len(env.render()) == 11
    again = gymnasium.make(env.spec)
    assert again.reset(seed=0)[0].shape == (61,)
