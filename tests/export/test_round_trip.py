"""Every field of an exported episode is that of the rows from which it came, of any shape."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.export.reading import read_lerobot
from tests.export.stored import (
    cell,
    corrected,
    recording,
    store_cell,
    store_dataset,
    store_of,
)
from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.export.evaluated import evaluated_episodes
from wasp_cli.export.lerobot_file import write_lerobot
from wasp_cli.export.selection import selected
from wasp_cli.export.written import source_of
from wasp_cli.seeds import derive

INFO = "complementary_info"


@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=3),
    action=st.integers(1, 4),
    state=st.one_of(st.none(), st.integers(1, 5)),
    seed=st.integers(0, 9),
)
@settings(max_examples=12)
def test_a_dataset_of_any_shape_is_the_same_as_frames_of_lerobot(
    tmp_path_factory: pytest.TempPathFactory,
    lengths: list[int],
    action: int,
    state: int | None,
    seed: int,
) -> None:
    folder = tmp_path_factory.mktemp("lerobot")
    layout = store_of(folder)
    shards = [
        recording(lengths, action, state, seed=seed),
        recording([2], action, state, len(lengths)),
    ]
    store_dataset(layout, shards)
    written = write_lerobot(
        source_of(layout, selected(layout, ["goal1 dataset"])), folder / "exported"
    )
    assert (written.episodes, written.decisions) == (len(lengths) + 1, sum(lengths) + 2)

    frames = read_lerobot(folder / "exported")
    episode = 0
    for shard in shards:
        for number in sorted(set(shard.episode.tolist())):
            rows = np.flatnonzero(shard.episode == number)
            mine = frames.of(episode)
            before, after = rows[:-1], rows[1:]
            if state is None:
                images = np.moveaxis(shard.pixels[before], 1, -1)
                assert np.array_equal(mine["observation.images.front"], images[..., :3])
                assert np.array_equal(mine["observation.images.rear"], images[..., 3:])
            else:
                seen = mine["observation.state"].reshape(len(before), -1)
                assert np.array_equal(seen, shard.state[before])
            for name in ("action", f"{INFO}.command"):
                assert np.array_equal(mine[name].reshape(len(after), -1), shard.action[after])
            assert np.array_equal(mine["next.reward"], shard.reward[after])
            assert np.array_equal(mine[f"{INFO}.cost"], shard.cost_env[after])
            assert np.array_equal(mine[f"{INFO}.goals"], shard.goals[after])
            assert np.array_equal(mine[f"{INFO}.privileged"], shard.privileged[before])
            assert not mine[f"{INFO}.is_intervention"].any()
            assert mine["next.done"].tolist() == [False] * (len(after) - 1) + [True]
            assert mine["next.truncated"][-1] == (shard.terminal[after[-1]] == 0)
            about = frames.episodes[episode]
            assert about["wasp/driver"] == f"driver{number}"
            assert about["wasp/world_seed"] == derive("dataset-episode", "goal1", 1, number)
            assert about["wasp/return"] == pytest.approx(float(shard.reward[after].sum()), abs=1e-5)
            episode += 1


@pytest.mark.parametrize("action", [1, 2, 3])
def test_commands_gates_and_the_flag_of_an_intervention_are_those_of_a_cell(
    tmp_path: Path, action: int
) -> None:
    layout = store_of(tmp_path)
    trajectories = [corrected(5, action), corrected(3, action, seed=1)]
    store_cell(layout, trajectories, cell())
    source = source_of(layout, selected(layout, ["goal1 s1 wasp"]), observations=False)
    write_lerobot(source, tmp_path / "exported")

    frames = read_lerobot(tmp_path / "exported")
    assert not [name for name in frames.columns if name.startswith("observation")]
    for episode, driven in enumerate(trajectories):
        mine = frames.of(episode)
        for name, expected in (("action", driven.a), (f"{INFO}.command", driven.a_h)):
            assert np.array_equal(mine[name].reshape(driven.steps, -1), expected), name
        for name, expected in (
            ("next.reward", driven.reward),
            (f"{INFO}.cost", driven.cost_env),
            (f"{INFO}.goals", driven.goals),
            (f"{INFO}.gate", driven.gate),
            (f"{INFO}.is_intervention", driven.gate == 1),
            (f"{INFO}.predicted_cost", driven.g_cost),
            (f"{INFO}.predicted_gain", driven.delta_g),
        ):
            assert np.array_equal(
                mine[name].astype(float), np.asarray(expected, float), equal_nan=True
            ), name
        about = frames.episodes[episode]
        assert about["wasp/label"] == "goal1 s1 wasp laggy=0.7"
        assert (about["wasp/method"], about["wasp/driver"], about["wasp/value"]) == (
            "wasp",
            "laggy",
            0.7,
        )
        assert about["wasp/world_seed"] == 100 + episode
        assert mine["next.truncated"].tolist() == [False] * driven.steps, "it ended early"


def test_statistics_are_those_of_all_frames_and_none_of_what_is_undefined(tmp_path: Path) -> None:
    layout = store_of(tmp_path)
    shard = recording([4, 7], 2, None)
    store_dataset(layout, [shard])
    write_lerobot(source_of(layout, selected(layout, ["dataset"])), tmp_path / "exported")
    frames = read_lerobot(tmp_path / "exported")
    for name in ("action", "next.reward", "observation.images.front"):
        values = frames.columns[name].astype(np.float64)
        stats = {which: np.array(numbers) for which, numbers in frames.stats[name].items()}
        axes = (0, 1, 2) if values.ndim == 4 else 0
        unit = 255.0 if values.ndim == 4 else 1.0
        for which in ("min", "max", "mean", "std"):
            expected = getattr(values, which)(axes) / unit
            assert stats[which].ravel() == pytest.approx(np.ravel(expected), abs=1e-9), (
                name,
                which,
            )
        assert stats["count"].tolist() == [11]
        assert (stats["q01"] <= stats["q50"]).all()
        assert (stats["q50"] <= stats["q99"]).all()
    assert np.shape(frames.stats["observation.images.front"]["mean"]) == (3, 1, 1)
    assert f"{INFO}.signal" not in frames.stats
    assert "NaN" not in (tmp_path / "exported/meta/stats.json").read_text()


def test_a_task_with_one_camera_has_one_image(tmp_path: Path) -> None:
    layout = store_of(tmp_path)
    shard = recording([2], 2, None)
    shard.pixels[:, 3:] = 0
    store_dataset(layout, [shard])
    write_lerobot(source_of(layout, selected(layout, ["dataset"])), tmp_path / "exported")
    features = json.loads((tmp_path / "exported/meta/info.json").read_text())["features"]
    assert [name for name in features if "image" in name] == ["observation.images.front"]


def test_what_was_published_without_steps_is_told_or_refused(tmp_path: Path) -> None:
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    from wasp_cli.store.parquet import write_table

    layout = store_of(tmp_path)
    store_cell(layout, [corrected(4), corrected(4)], cell())
    (node,) = selected(layout, ["wasp"])
    steps = pq.read_table(node.path / "_steps.pq")
    told: list[str] = []
    for kept in (1, 0):
        write_table(steps.filter(pc.less(steps["episode"], kept)), node.path / "_steps.pq")
        if kept:
            (episode,) = evaluated_episodes(node, observations=False, told=told.append)
            assert episode.decisions == 4
            assert "1 of 2 episodes have steps" in told[0]
        else:
            with pytest.raises(UsageError, match="has no steps"):
                next(evaluated_episodes(node, observations=False))


def test_damaged_rows_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    layout = store_of(tmp_path)
    key = store_dataset(layout, [recording([3], 2, 4)])
    shard = layout.artifact("dataset", key) / "shard-0000.parquet"
    data = bytearray(shard.read_bytes())
    data[40] ^= 1
    shard.write_bytes(data)
    source = source_of(layout, selected(layout, ["dataset"]))
    with pytest.raises(ArtifactError, match="other bytes"):
        write_lerobot(source, tmp_path / "exported")
    assert {path.name for path in tmp_path.iterdir()} == {"results"}
