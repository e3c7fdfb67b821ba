"""Minari: a published cell that `wasp export` wrote plays again exactly in the environment that the
dataset recovers.
"""

import minari
import numpy as np

from tests.commands import ROOT
from wasp_cli.export.minari_file import write_minari
from wasp_cli.export.selection import selected
from wasp_cli.export.written import source_of
from wasp_cli.store.layout import Layout

CELL = "f7e6b96e"  # race1 s1 ida laggy=0.7, with the steps of its first episode


def test_an_exported_cell_plays_again(tmp_path, monkeypatch):
    layout = Layout(ROOT / "results" / "published")
    written = write_minari(source_of(layout, selected(layout, [CELL])), tmp_path / "race1-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("race1-v0")
    assert dataset.total_steps == written.decisions
    (facts,) = dataset.storage.get_episode_metadata([0])
    assert facts["wasp"]["label"] == "race1 s1 ida laggy=0.7"
    episode = dataset[0]
    assert episode.infos["intervened"].any()

    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    seen, info = env.reset(seed=facts["seed"])
    for t in range(len(episode)):
        assert seen.tobytes() == episode.observations[t].tobytes()
        seen, reward, terminated, truncated, info = env.step(episode.actions[t])
        assert np.float32(reward) == episode.rewards[t]
        assert info["cost"] == episode.infos["cost"][t + 1]
        assert (terminated, truncated) == (episode.terminations[t], episode.truncations[t])
    assert seen.tobytes() == episode.observations[-1].tobytes()
    assert terminated or truncated
