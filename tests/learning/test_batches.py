"""Cells in batches of episodes: what a cell of fewer has is taken over, and nothing comes out differently."""

import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.cells import SETTINGS, Evaluated, evaluated
from wasp_cli.learning.configs import CounterfactualConfig
from wasp_cli.metrics.necessity import ASSISTED
from wasp_cli.stages.base import Job
from wasp_cli.stages.counterfactual import CounterfactualStage
from wasp_cli.store.branches import BRANCHES_FILE
from wasp_cli.store.slim import first_episodes
from wasp_cli.store.tables import ADDED, TIMING, VERSION_KEY, read_episodes, read_steps, read_times, same_rows

EAGER = {"vote": 0.0}  # IDA that intervenes at some decisions, and not at others, although nothing is trained


@pytest.fixture(scope="module")
def whole(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(inputs, tmp_path_factory.mktemp("whole"), "ida", EAGER, episodes=5, side_by_side=2)


@pytest.mark.parametrize(("episodes", "kept"), [(3, 2)])
def test_a_cell_goes_on_where_whole_batches_of_one_of_fewer_episodes_end(episodes, kept, whole, inputs, tmp_path, monkeypatch):
    fewer = evaluated(inputs, tmp_path / "fewer", "ida", EAGER, episodes=episodes, side_by_side=2)
    begun: list[int] = []
    monkeypatch.setattr("wasp_cli.seeds.layout_seed", counted(begun))
    resumed = evaluated(inputs, tmp_path / "resumed", "ida", EAGER, episodes=5, side_by_side=2, earlier=fewer.path.parent)
    assert set(begun) == set(range(kept, 5))
    assert same_rows(whole.path, resumed.path)
    names = [name for name in pq.read_schema(whole.path).names if name not in TIMING]
    assert pq.read_table(whole.path, columns=names).equals(pq.read_table(resumed.path, columns=names))
    for e in range(kept):  # their times are those of the first time
        assert read_times(resumed.path)[e].tolist() == read_times(fewer.path)[e].tolist()


def test_rows_of_an_earlier_version_are_not_continued(inputs, tmp_path, monkeypatch):
    """They lack columns, which would then be means over the other episodes alone."""
    fewer = evaluated(inputs, tmp_path / "fewer", "ida", EAGER, episodes=2, side_by_side=2)
    table = pq.read_table(fewer.path).drop_columns([*ADDED])
    pq.write_table(table.replace_schema_metadata({VERSION_KEY: b"3"}), fewer.path, write_page_checksum=True)
    begun: list[int] = []
    monkeypatch.setattr("wasp_cli.seeds.layout_seed", counted(begun))
    again = evaluated(inputs, tmp_path / "again", "ida", EAGER, episodes=3, side_by_side=2, earlier=fewer.path.parent)
    assert set(begun) == {0, 1, 2}
    assert read_episodes([again.path])["int_eff"].null_count == 0


def test_a_cell_that_is_cut_after_whole_batches_is_the_one_of_fewer_episodes(whole, inputs, tmp_path):
    fewer = evaluated(inputs, tmp_path / "fewer", "ida", EAGER, episodes=4, side_by_side=2)
    copy = shutil.copytree(whole.path.parent, tmp_path / "cut")
    summary = first_episodes(copy, 4)
    assert same_rows(copy / "episodes.parquet", fewer.path)
    means = {name: np.mean(pq.read_table(fewer.path)[name]) for name in ("return", "cost", "int_rate")}
    assert summary == {"return": round(means["return"], 2), "cost": round(means["cost"], 1), "int": round(means["int_rate"], 3)}


def counted(begun: list[int]) -> object:
    from wasp_cli.seeds import layout_seed

    def seed(task: str, number: int, episode: int) -> int:
        begun.append(episode)
        return layout_seed(task, number, episode)

    return seed


def test_the_branches_of_every_batch_come_back_in_it(whole, inputs, tmp_path):
    """What the recorded action earns is what it earned: bit for bit, in all batches."""
    cell = whole
    out = tmp_path / "out"
    out.mkdir()
    settings = {**SETTINGS, "side_by_side": 2}
    axes = {"method": "ida", "method_config": {}, "operator": cell.variant, "value": cell.value}
    read = {**inputs, "evaluate": cell.path.parent}
    config = CounterfactualConfig(window=1)
    summary = CounterfactualStage().run(Job("counterfactual", "race1", 0, config, settings, axes, read, out, out))
    steps = {(step["episode"], step["t"]): step for step in read_steps(cell.path).to_pylist()}
    rows = [row for row in pq.read_table(out / BRANCHES_FILE).to_pylist() if row["branch"] == ASSISTED]
    assert {row["episode"] for row in rows} == set(range(5))
    assert len(rows) == summary["interventions"]
    for row in rows:
        assert row["rewards"] == [steps[row["episode"], row["t"]]["reward"]]
