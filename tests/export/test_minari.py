"""Minari reads what is exported: every field is that of the rows."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.export.stored import cell, corrected, recording, store_cell, store_dataset, store_of
from wasp_cli.export.selection import selected
from wasp_cli.export.written import source_of

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

from wasp_cli.export.minari_file import write_minari  # noqa: E402  # needs Minari

OF_RESET = ("cost", "goals", "gate", "intervened")
"""Infos that are zero at the reset."""


@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=12),
    action=st.integers(1, 4),
    state=st.one_of(st.none(), st.integers(1, 5)),
)
@settings(max_examples=6)
def test_a_dataset_of_any_shape_is_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    lengths: list[int],
    action: int,
    state: int | None,
) -> None:
    folder = tmp_path_factory.mktemp("minari")
    layout = store_of(folder)
    shard = recording(lengths, action, state)
    # A task whose environment nobody makes here.
    store_dataset(layout, [shard], task="goal1" if state is not None else "my_pkg:Mine-v0")
    written = write_minari(
        source_of(layout, selected(layout, ["dataset"])), folder / "datasets/mine-v3"
    )
    assert (written.episodes, written.decisions) == (len(lengths), sum(lengths))

    dataset = minari.MinariDataset(folder / "datasets/mine-v3/data")
    assert dataset.total_steps == sum(lengths)
    facts = list(dataset.storage.get_episode_metadata(range(len(lengths))))
    for number, episode in enumerate(dataset.iterate_episodes()):
        rows = np.flatnonzero(shard.episode == number)
        after = rows[1:]
        assert np.array_equal(episode.observations, shard.seen[rows])
        assert episode.observations[0] in dataset.observation_space
        assert episode.actions[0] in dataset.action_space
        assert np.array_equal(episode.actions, shard.action[after])
        assert np.array_equal(episode.rewards, shard.reward[after])
        assert np.array_equal(episode.infos["command"][1:], shard.action[after])
        assert np.array_equal(episode.infos["cost"], shard.cost_env[rows])
        assert np.array_equal(episode.infos["goals"], shard.goals[rows])
        assert np.array_equal(episode.infos["privileged"], shard.privileged[rows])
        assert not episode.infos["intervened"].any()
        assert episode.terminations[-1] == (shard.terminal[rows[-1]] == 1)
        assert episode.truncations[-1] != episode.terminations[-1]
        assert facts[number]["wasp"]["driver"] == f"driver{number}"
        assert facts[number]["seed"] == facts[number]["wasp"]["world_seed"]


def test_a_cell_is_the_same_and_is_found_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = store_of(tmp_path)
    driven = corrected(5)
    store_cell(layout, [driven, corrected(2)], cell())
    source = source_of(layout, selected(layout, ["wasp"]), observations=False)
    write_minari(source, tmp_path / "datasets/goal1-wasp-v0")

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    assert list(minari.list_local_datasets()) == ["goal1-wasp-v0"]
    dataset = minari.load_dataset("goal1-wasp-v0")
    assert dataset.storage.metadata["gates"]["1"] == "safety"
    episode = dataset[0]
    assert np.array_equal(episode.actions, driven.a)
    assert episode.observations.tolist() == [[0], [1], [2], [3], [4], [5]]
    for name, expected in (
        ("command", driven.a_h),
        ("intervened", driven.gate == 1),
        ("gate", driven.gate),
        ("cost", driven.cost_env),
        ("predicted_cost", driven.g_cost),
        ("predicted_gain", driven.delta_g),
    ):
        recorded = episode.infos[name]
        assert np.array_equal(recorded[1:], expected, equal_nan=name.startswith("predicted")), name
        assert not recorded[0].any() if name in OF_RESET else True
