"""skrl: its wrapper passes on what the environments give, single and batched."""

import gymnasium
import numpy as np
import pytest
import torch
from skrl.envs.wrappers.torch import wrap_env

import wasp_cli.tasks.gym  # noqa: F401  # registers the ids
from tests.peers import IDS


@pytest.mark.parametrize("mode", [None, "sync", "vector_entry_point"])
def test_its_wrapper_passes_everything_on(mode):
    rows = 1 if mode is None else 2

    def made():
        options = {"observation": "privileged", "action_repeat": 250}
        return (
            gymnasium.make(IDS[0], **options)
            if mode is None
            else gymnasium.make_vec(IDS[0], rows, mode, **options)
        )

    wrapped, plain = wrap_env(made()), made()
    assert (wrapped.num_envs, wrapped.action_space.shape) == (rows, (2,))
    seen, _ = wrapped.reset()
    plain.reset()
    assert seen.shape == (rows, wrapped.observation_space.shape[0])
    wrapped._unwrapped.reset(seed=4)
    plain.reset(seed=4)
    random = np.random.default_rng(0)
    for _ in range(4):
        action = random.uniform(-1, 1, (rows, 2)).astype(np.float32)
        observation, reward, terminated, truncated, info = wrapped.step(torch.from_numpy(action))
        expected = plain.step(action[0] if mode is None else action)
        assert (observation.numpy().reshape(rows, -1) == np.reshape(expected[0], (rows, -1))).all()
        assert (reward.numpy().ravel() == np.float32(expected[1])).all()
        assert (terminated.numpy().ravel() == expected[2]).all()
        assert (truncated.numpy().ravel() == expected[3]).all()
        assert (info["cost"] == expected[4]["cost"]).all()
    assert truncated.all()
