"""LeRobot reads what `wasp export` writes: its dataset, its policies' inputs, and the replay buffer
of its HIL-SERL. `nox -s lerobot` installs it in an environment of its own.
"""

import numpy as np
import pytest

from tests.export.stored import cell, corrected, recording, store_cell, store_dataset, store_of
from wasp_cli.export.lerobot_file import write_lerobot
from wasp_cli.export.selection import selected
from wasp_cli.export.written import source_of

pytest.importorskip("lerobot")

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.feature_utils import dataset_to_policy_features

DECISION = 0.08  # seconds, of Goal1


@pytest.mark.parametrize("state", [None, 5], ids=["images", "vectors"])
def test_a_dataset_of_a_training_is_read(state, tmp_path):
    layout = store_of(tmp_path)
    shard = recording([4, 6], 2, state)
    store_dataset(layout, [shard])
    write_lerobot(source_of(layout, selected(layout, ["dataset"])), tmp_path / "mine")

    ahead = {"action": [0.0, DECISION, 2 * DECISION]}
    dataset = LeRobotDataset("wasp/mine", root=tmp_path / "mine", delta_timestamps=ahead)
    assert (dataset.num_episodes, len(dataset)) == (2, 10)
    before = np.flatnonzero(np.diff(shard.episode, append=-1) == 0)
    for frame, row in enumerate(before):
        item = dataset[frame]
        if state is None:
            for name, channels in (("front", slice(3)), ("rear", slice(3, 6))):
                seen = (item[f"observation.images.{name}"].numpy() * 255).round()
                assert np.array_equal(seen, shard.pixels[row][channels])
        else:
            assert np.array_equal(item["observation.state"].numpy(), shard.state[row])
        assert np.array_equal(item["action"][0].numpy(), shard.action[row + 1])
        assert item["next.reward"].item() == shard.reward[row + 1]
        assert item["timestamp"].item() == pytest.approx(DECISION * item["frame_index"].item())
        assert item["task"] == "Goal1: high return at little cost"
    assert dataset.meta.episodes[1]["wasp/driver"] == "driver1"
    wanted = {"observation.state"}
    if state is None:
        wanted = {"observation.images.front", "observation.images.rear"}
    assert set(dataset_to_policy_features(dataset.meta.features)) == {"action", *wanted}


def test_the_flag_of_an_intervention_is_that_of_its_own_recordings(tmp_path):
    from lerobot.rl.buffer import ReplayBuffer

    layout = store_of(tmp_path)
    driven = corrected(6)
    store_dataset(layout, [recording([3], 2, 5)])
    store_cell(layout, [driven], cell())
    source = source_of(layout, selected(layout, ["wasp"]), observations=False)
    write_lerobot(source, tmp_path / "cells")
    dataset = LeRobotDataset("wasp/cells", root=tmp_path / "cells")
    flags = [dataset[t]["complementary_info.is_intervention"].item() for t in range(6)]
    assert flags == [0, 1, 0, 1, 0, 1]
    for t in range(6):
        assert np.array_equal(dataset[t]["complementary_info.command"].numpy(), driven.a_h[t])

    write_lerobot(source_of(layout, selected(layout, ["dataset"])), tmp_path / "recorded")
    recorded = LeRobotDataset("wasp/recorded", root=tmp_path / "recorded")
    buffer = ReplayBuffer.from_lerobot_dataset(
        recorded, device="cpu", state_keys=["observation.state"], capacity=10
    )
    assert len(buffer) == 3
    assert buffer.complementary_info["is_intervention"][:3].tolist() == [0, 0, 0]
