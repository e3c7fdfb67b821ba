from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.store.test_tables import CELL, invent
from wasp_cli.errors import StoreError
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.tables import STEPS_FILE, Thresholds, write_cell

EPISODES = [invent(0, 5), invent(1, 1), invent(2, 9)]


@pytest.fixture
def path(tmp_path) -> Path:
    rows = [episode_metrics(trajectory, 3, 25.0) for trajectory in EPISODES]
    return write_cell(tmp_path, CELL, EPISODES, rows, Thresholds(), [np.ones(t.steps) for t in EPISODES], [11, 12, 13])


def test_commands_actions_and_rewards_come_back_episode_by_episode(path):
    recorded = read_recorded(path)
    assert recorded["layouts"] == [11, 12, 13]
    for e, trajectory in enumerate(EPISODES):
        for name in ("a_h", "a", "reward"):
            assert recorded[name][e].dtype == np.float32
            np.testing.assert_array_equal(recorded[name][e], getattr(trajectory, name).astype(np.float32))


@pytest.mark.parametrize("damage", ["no episode", "an episode is missing", "steps are missing", "no actions"])
def test_rows_that_are_no_whole_episodes_are_refused(path, damage):
    table = pq.read_table(path)
    if damage == "no episode":
        table = table.slice(0, 0)
    elif damage == "an episode is missing":
        table = pa.concat_tables([table.slice(0, 1), table.slice(2, 1)])
    elif damage == "steps are missing":
        table = table.set_column(table.column_names.index("decisions"), table.schema.field("decisions"), [pa.array([5, 2, 9], pa.int32())])
    else:
        steps = pq.read_table(path.with_name(STEPS_FILE))
        rows = [step | {"a": []} for step in steps.to_pylist()]
        pq.write_table(pa.Table.from_pylist(rows, schema=steps.schema), path.with_name(STEPS_FILE))
    pq.write_table(table, path)
    with pytest.raises(StoreError, match=r"whole episodes|'a' is missing"):
        read_recorded(path)
