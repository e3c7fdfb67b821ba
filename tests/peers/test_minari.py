"""Minari: episodes that its collector recorded, infos included, play again exactly in the
environment that the dataset recovers.
"""

import gymnasium
import minari
import numpy as np
import pytest

import wasp_cli.tasks.gym  # noqa: F401  # registers the ids
from tests.peers import IDS


@pytest.mark.filterwarnings("ignore:`eval_env` is set to None|.*is set to None. For .*:UserWarning")
@pytest.mark.parametrize(
    ("name", "observation"),
    [*((name, "state") for name in IDS), (IDS[0], "all"), (IDS[3], "vision")],
)
def test_what_it_recorded_plays_again(name, observation, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    made = gymnasium.make(name, observation=observation, action_repeat=100)
    env = minari.DataCollector(made, record_infos=True, jpeg_encoding=False)
    random = np.random.default_rng(0)
    for seed in (5, None):
        env.reset(seed=seed)
        done = False
        while not done:
            *_, terminated, truncated, _ = env.step(random.uniform(-1, 1, 2))
            done = terminated or truncated
    dataset = env.create_dataset(
        "wasp/test-v0",
        algorithm_name="random",
        author="wasp",
        author_email="w@example.org",
        code_permalink="-",
    )
    assert dataset.total_episodes == 2

    again = dataset.recover_environment()
    assert again.spec.max_episode_steps == made.spec.max_episode_steps
    seeds = [data["seed"] for data in dataset.storage.get_episode_metadata(range(2))]
    assert seeds[0] == 5
    for episode, seed in zip(dataset.iterate_episodes(), seeds, strict=True):
        seen, info = again.reset(seed=int(seed))
        for step in range(len(episode) + 1):
            for recorded, field in _pairs(episode.observations, seen):
                assert recorded[step].tobytes() == np.asarray(field).tobytes()
            for key, value in info.items():
                assert episode.infos[key][step] == value, (step, key)
            if step < len(episode):
                seen, reward, terminated, truncated, info = again.step(episode.actions[step])
                assert (reward, terminated) == (episode.rewards[step], episode.terminations[step])
        assert terminated or truncated


def _pairs(recorded, seen):
    """Of every entry of an observation: what was recorded of all steps, and what is seen now."""
    return (
        [(recorded[name], seen[name]) for name in seen]
        if isinstance(seen, dict)
        else [(recorded, seen)]
    )
