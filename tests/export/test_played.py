"""What cells do not store: their actions are carried out again, and show what was seen."""

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.cells import DECISIONS, REPEAT, Evaluated, evaluated, short_episodes
from wasp_cli.errors import ArtifactError
from wasp_cli.export.evaluated import evaluated_episodes
from wasp_cli.store.find import FoundNode
from wasp_cli.store.parquet import write_table
from wasp_cli.tasks.make import make_task


@pytest.fixture(scope="module")
def driven(
    artifacts: Mapping[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Evaluated]:
    with short_episodes():
        yield evaluated(artifacts, tmp_path_factory.mktemp("cell"), episodes=2)


def node_of(folder: Path) -> FoundNode:
    manifest = {
        "task": "race1",
        "seed": 0,
        "label": "race1 s0 human noisy=0.4",
        "settings": {"action_repeat": REPEAT},
    }
    return FoundNode(folder, "e0", manifest, "evaluate")


def test_what_is_seen_is_what_a_world_shows_under_the_recorded_actions(driven: Evaluated) -> None:
    first, second = evaluated_episodes(node_of(driven.path.parent), observations=True)
    assert (first.number, second.number) == (0, 1)
    world = make_task("race1", 1, action_repeat=REPEAT, observe=("pixels", "privileged"))
    seen = world.reset([second.world_seed])
    for t, action in enumerate(second.action):
        assert np.array_equal(seen.pixels[0], second.seen[t])
        assert np.array_equal(seen.privileged[0], second.privileged[t])
        step = world.step(action[None])
        seen = step.observation
        assert np.float32(step.reward[0]) == second.reward[t]
        assert step.cost_env[0] == second.cost_env[t]
    assert np.array_equal(seen.pixels[0], second.seen[-1])
    assert len(second.seen) == len(second.action) + 1 == DECISIONS + 1
    assert not second.terminated, "it ran into its time limit"
    assert (first.seen[0] != second.seen[0]).any(), "they are other worlds"


def test_an_episode_that_leads_elsewhere_is_refused_with_how_to_leave_out_what_was_seen(
    driven: Evaluated, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(driven.path.parent, tmp_path / "cell"))
    steps = pq.read_table(folder / "_steps.pq")
    rewards = np.asarray(steps["reward"]).copy()
    rewards[3] += 1
    place = steps.schema.get_field_index("reward")
    changed = steps.set_column(place, steps.schema.field(place), pa.array(rewards))
    write_table(changed, folder / "_steps.pq")
    with pytest.raises(ArtifactError, match="race1 s0 human") as error:
        next(evaluated_episodes(node_of(folder), observations=True))
    assert "--no-observations" in (error.value.hint or "")
    episode = next(evaluated_episodes(node_of(folder), observations=False))
    assert episode.seen is None
    assert episode.reward[3] == rewards[3]
