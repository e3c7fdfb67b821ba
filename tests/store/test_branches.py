"""The table of branches: what is written comes back, and what is no such table is refused."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wasp_cli.errors import StoreError
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.store.branches import CELL_KEY, VERSION_KEY, BranchedCell, BranchRow, read_branches, write_branches
from wasp_cli.store.tables import RENAMED, CellIdentity

CELL = BranchedCell(CellIdentity("goal1", "wasp", "full", "noisy", 0.4, 3), window=4, stride=2, tau_R=0.25, episodes=7)


def row(episode: int, t: int, branch: str, steps: int = 4) -> BranchRow:
    random = np.random.default_rng([episode, t, branch == ALONE])
    costs = random.random(steps) < 0.5
    return BranchRow(episode, t, branch, costs, 3 * costs, random.normal(size=steps), 0.5 + t, 1)


ROWS = [row(e, t, name) for e, t in ((0, 2), (0, 5), (3, 0)) for name in (ASSISTED, ALONE)] + [row(6, 9, ASSISTED, 2), row(6, 9, ALONE, 1)]


def test_pairs_come_back_side_by_side_with_zeros_after_the_end(tmp_path):
    write_branches(tmp_path / "b.parquet", CELL, ROWS)
    found = read_branches(tmp_path / "b.parquet")
    assert found.cell == CELL
    assert found.episode.tolist() == [0, 0, 3, 6]
    assert found.t.tolist() == [2, 5, 0, 9]
    assert found.deviation.tolist() == [2.5, 5.5, 0.5, 9.5]
    assert found.gate.tolist() == [1, 1, 1, 1]
    for place, first in enumerate(range(0, len(ROWS), 2)):
        for name, each in ((ASSISTED, ROWS[first]), (ALONE, ROWS[first + 1])):
            steps = len(each.costs)
            assert found.cost[name][place].tolist() == [*map(float, each.costs), *[0.0] * (4 - steps)]
            np.testing.assert_array_equal(found.reward[name][place, :steps], np.asarray(each.rewards, np.float32))
            assert not found.reward[name][place, steps:].any()


def changed(name: str, place: int, value: Any) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        rows = table.to_pylist()
        rows[place][name] = value
        return pa.Table.from_pylist(rows, schema=table.schema)

    return change


def marked(**marks: str) -> Callable[[pa.Table], pa.Table]:
    new = {f"wasp.{name}".encode(): text.encode() for name, text in marks.items()}
    return lambda table: table.replace_schema_metadata(table.schema.metadata | new)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda table: table.replace_schema_metadata({}), "not a table of counterfactual branches"),
        (marked(branches="3"), "table version 3, this wasp reads up to 2"),
        (marked(branches="new"), "is damaged"),
        (marked(branched_cell="{}"), "is damaged"),
        (marked(branched_cell="[]"), "is damaged"),
        (lambda table: table.drop_columns(["rewards"]), "is damaged"),
        (lambda table: table.slice(1), "not sorted pairs"),
        (lambda table: table.slice(0, 1), "not sorted pairs"),
        (lambda table: pa.concat_tables([table.slice(2), table.slice(0, 2)]), "not sorted pairs"),
        (lambda table: pa.concat_tables([table.slice(0, 2), table]), "not sorted pairs"),
        (changed("branch", 0, "ass"), "not sorted pairs"),
        (changed("steps", 0, 3), "a branch of 3 steps has 4 costs"),
        (changed("costs", 0, []), "0 costs"),
        (changed("rewards", 0, [1.0] * 5), "5 rewards"),
        (changed("rewards", 0, [1.0, float("nan"), 1.0, 1.0]), "not finite"),
        (changed("costs", 0, [None, True, True, True]), "not finite"),
    ],
)
def test_what_is_no_table_of_branches_is_refused(tmp_path, change, what):
    path = tmp_path / "b.parquet"
    write_branches(path, CELL, ROWS)
    pq.write_table(change(pq.read_table(path)), path)
    with pytest.raises(StoreError, match=what):
        read_branches(path)


def test_a_flipped_byte_among_the_rows_is_noticed_or_changes_nothing(tmp_path):
    path = tmp_path / "b.parquet"
    write_branches(path, CELL, ROWS)
    data = path.read_bytes()
    expected = pq.read_table(path)
    noticed = 0
    for place in range(4, len(data) // 2, 37):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        try:
            read_branches(path)
        except StoreError:
            noticed += 1
        else:
            assert pq.read_table(path).equals(expected)
    assert noticed > 5


def test_former_names_of_columns_are_read(tmp_path):
    path, former = tmp_path / "b.parquet", tmp_path / "former.parquet"
    write_branches(path, CELL, ROWS)
    table = pq.read_table(path)
    told = json.loads(table.schema.metadata[CELL_KEY])
    told["identity"] = {RENAMED.get(name, name): value for name, value in told["identity"].items()}
    marks = {VERSION_KEY: b"1", CELL_KEY: json.dumps(told).encode()}
    pq.write_table(table.rename_columns(RENAMED).replace_schema_metadata(marks), former, write_page_checksum=True)
    found, now = read_branches(former), read_branches(path)
    assert found.cell == now.cell == CELL
    assert (found.t.tolist(), found.deviation.tolist()) == (now.t.tolist(), now.deviation.tolist())
