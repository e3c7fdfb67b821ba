import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.plans import plans_of, trajectory
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.rows import read_rows
from wasp_cli.errors import StoreError
from wasp_cli.metrics.episode import EpisodeMetrics, Plans, Trajectory, episode_metrics
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.report.stats import read_frame
from wasp_cli.report.tables.main import autonomy_table
from wasp_cli.store import tables
from wasp_cli.store.branches import (
    CELL_KEY,
    VERSION_KEY,
    BranchedCell,
    BranchRow,
    read_branches,
    write_branches,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import (
    EPISODES_FILE,
    STEPS_FILE,
    CellIdentity,
    Thresholds,
    read_episodes,
    read_steps,
    same_rows,
    write_cell,
)

ROOT = Path(__file__).parents[2]
CELL = CellIdentity("goal1", "wasp", "full", "noisy", 0.4, 3)


def invent(seed: int, steps: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    acts = rng.random(steps) < 0.5
    a_h = rng.uniform(-1, 1, (steps, 2))
    cost_env = rng.integers(0, 3, steps)
    done = {
        "reward": rng.normal(size=steps),
        "cost": cost_env > 0,
        "cost_env": cost_env,
        "goals": rng.integers(0, 2, steps),
    }
    seen = {
        "g_cost": rng.random(steps),
        "g_return": rng.random(steps),
        "delta_g": np.where(acts, 0.5, np.nan),
    }
    a, gate = np.where(acts[:, None], -a_h, a_h), np.where(acts, 1, 0).astype(np.int8)
    return trajectory(
        steps, **done, **seen, a_h=a_h, a=a, gate=gate, plans=plans_of(np.where(acts, 0.25, np.nan))
    )


@pytest.fixture
def write(tmp_path) -> Callable[..., Path]:
    def make(
        name: str = "cell", cell: CellIdentity = CELL, seed: int = 0, slowness: float = 1.0
    ) -> Path:
        trajectories = [invent(seed, 5), invent(seed + 1, 1), invent(seed + 2, 9)]
        rows = [episode_metrics(trajectory, 3, 25.0) for trajectory in trajectories]
        times = [slowness * np.arange(1.0, trajectory.steps + 1) for trajectory in trajectories]
        (tmp_path / name).mkdir()
        return write_cell(
            tmp_path / name,
            cell,
            trajectories,
            rows,
            Thresholds(tau_c=0.3, tau_r=0.41),
            times,
            [11, 12, 13],
        )

    return make


def test_episodes_round_trip(write):
    table = read_episodes([write()])
    assert table.num_rows == 3
    assert "steps" not in table.column_names
    assert "decision_ms" not in table.column_names
    rows = table.to_pylist()
    assert [row["episode_seed"] for row in rows] == [11, 12, 13]
    assert [row["decisions"] for row in rows] == [5, 1, 9]
    assert {
        (row["task"], row["method"], row["variant"], row["operator"], row["value"], row["seed"])
        for row in rows
    } == {("goal1", "wasp", "full", "noisy", 0.4, 3)}
    assert (rows[0]["tau_c"], rows[0]["tau_r"], rows[0]["tau_q"]) == (0.3, 0.41, None)
    assert (rows[0]["decision_p50_ms"], rows[0]["decision_p95_ms"]) == (3.0, pytest.approx(4.8))
    wanted = episode_metrics(invent(0, 5), 3, 25.0)
    assert (rows[0]["return"], rows[0]["mag_int"], rows[0]["case2"]) == (
        wanted.return_,
        wanted.mag_int,
        wanted.case2,
    )
    assert rows[1]["smoothness"] is None


def test_steps_round_trip(write):
    steps = read_steps(write()).to_pylist()
    assert [(step["episode"], step["t"]) for step in steps] == [(0, t) for t in range(5)] + [
        (1, 0)
    ] + [(2, t) for t in range(9)]
    episode = invent(2, 9)
    for t, step in enumerate(steps[6:]):
        assert step["reward"] == np.float32(episode.reward[t])
        assert step["a"] == episode.a[t].astype(np.float32).tolist()
        assert step["a_h"] == episode.a_h[t].astype(np.float32).tolist()
        assert step["deviation"] == np.float32(episode.deviation[t])
        assert step["cost"] == (step["cost_env"] > 0)
        assert step["g_return"] == np.float32(episode.g_return[t])
        assert step["signal"] is None
        planned = (
            "plan",
            "safe",
            "case2",
            "plan_cost",
            "plan_return",
            "alone_cost",
            "alone_return",
        )
        if not step["gate"]:
            assert all(step[name] is None for name in planned)
            continue
        assert step["safe"] == [17] * 4
        assert step["case2"] == [True, False, False, False]
        assert step["plan"] == [0.0, 0.25, 0.5, 0.75, 1.0, 1.25]
        assert [step[name] for name in planned[3:]] == [t / 8 + i for i in range(4)]


def test_a_plan_without_a_search_keeps_what_was_carried_out(tmp_path):
    episode = invent(0, 5)
    planned = ~np.isnan(episode.plans.residuals).any((1, 2))
    assert planned.any()
    assert not planned.all()
    episode.plans.safe[:] = -1
    path = write_cell(
        tmp_path,
        CELL,
        [episode],
        [episode_metrics(episode, 3, 25.0)],
        Thresholds(),
        [np.ones(5)],
        range(1),
    )
    for step, was in zip(read_steps(path).to_pylist(), planned, strict=True):
        assert (step["safe"], step["case2"]) == (None, None)
        assert (
            (step["plan"] is not None)
            == (step["plan_cost"] is not None)
            == (step["alone_return"] is not None)
            == was
        )
    assert read_episodes([path])["case2"].to_pylist() == [None]


def test_same_rows_leaves_timing_out(write):
    first = write("a")
    assert same_rows(first, write("b", slowness=2.0))
    assert not same_rows(first, write("c", seed=1))
    assert not same_rows(
        first, write("d", cell=CellIdentity("goal1", "wasp", "full", "noisy", 0.6, 3))
    )


def test_every_column_is_written_from_its_own_field():
    """The schema and the dataclasses name the same things, so that a new metric cannot be
    forgotten in one of them.
    """
    metrics = {
        "return" if name == "return_" else name for name in EpisodeMetrics.__dataclass_fields__
    }
    assert {field.name for field in tables.METRICS} == metrics
    assert {field.name for field in tables.STEP} == (
        set(Trajectory.__dataclass_fields__) - {"plans"}
    ) | {"t", "deviation", *tables.PLANNED}
    assert set(tables.PLANNED.values()) == set(Plans.__dataclass_fields__)


@pytest.mark.parametrize(
    ("harm", "message"),
    [("gone", "does not exist"), ("other", "not the table of a cell"), ("cut", "is damaged")],
)
def test_what_is_no_table_of_a_cell_is_named(harm, message, write):
    path = write()
    if harm == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    elif harm == "other":
        pq.write_table(pa.table({"episode": [1]}), path)
    else:
        path.unlink()
    with pytest.raises(StoreError, match=rf"episodes\.parquet .*{message}"):
        read_episodes([path])


def test_steps_that_are_gone_or_a_link_are_named(write, tmp_path):
    path = write()
    steps = path.with_name(STEPS_FILE)
    steps.rename(tmp_path / "elsewhere.parquet")
    assert read_episodes([path]).num_rows == 3
    with pytest.raises(StoreError, match=r"_steps\.pq does not exist"):
        read_steps(path)
    steps.symlink_to(tmp_path / "elsewhere.parquet")
    for read in (read_steps, tables.read_times, lambda path: same_rows(path, path)):
        with pytest.raises(StoreError, match=r"_steps\.pq is no plain file"):
            read(path)


@pytest.mark.parametrize("file", [EPISODES_FILE, STEPS_FILE])
def test_a_flipped_bit_never_becomes_a_number(write, file):
    whole, hit = write("whole"), write("hit")
    path = hit.with_name(file)
    content = path.read_bytes()
    # has no checksum; the pages before it have
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    noticed = 0
    for place in range(0, footer, 37):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        try:
            assert same_rows(hit, whole)
        except StoreError:
            noticed += 1
    assert noticed > 30


def test_newer_version_is_refused(write):
    path = write()
    newer = pq.read_table(path).replace_schema_metadata({tables.VERSION_KEY: b"6"})
    pq.write_table(newer, path, write_page_checksum=True)
    with pytest.raises(StoreError, match="table version 6, this wasp reads up to 5") as caught:
        read_episodes([path])
    assert "upgrade" in caught.value.hint


def test_former_names_of_columns_are_read(write, tmp_path):
    path, former = write(), tmp_path / EPISODES_FILE  # as version 4 called its columns
    for name, key in ((EPISODES_FILE, tables.VERSION_KEY), (STEPS_FILE, tables.STEPS_KEY)):
        table = (
            pq.read_table(path.with_name(name))
            .rename_columns(tables.RENAMED)
            .replace_schema_metadata({key: b"4"})
        )
        pq.write_table(table, tmp_path / name, write_page_checksum=True)
    assert "assistant_variant" in pq.read_table(former).column_names
    assert (tables.read_version(former), read_episodes([former]).equals(read_episodes([path]))) == (
        4,
        True,
    )
    row = read_episodes([path]).slice(0, 1).to_pylist()[0]
    cell = RecordedCell(**{name: row[name] for name in tables.CellIdentity.__dataclass_fields__})
    found, now = (read_rows(each, cell, ("cost",)) for each in (former, path))
    assert found.table.equals(now.table)
    assert tables.first_rows(former.parent, 1).steps.equals(tables.first_rows(path.parent, 1).steps)
    assert same_rows(former, path)


def test_published_rows_do_not_define_what_later_versions_added():
    """They are read, by the quick reader too, and tables say n/a."""
    published = sorted(
        (ROOT / "results" / "published" / "store" / "evaluate").glob(f"*/{EPISODES_FILE}")
    )
    path = next(path for path in published if tables.read_version(path) < tables.ADDED_IN)
    rows = read_episodes([path])
    row = rows.slice(0, 1).to_pylist()[0]
    names = {name: row[name] for name in tables.CellIdentity.__dataclass_fields__}
    cell = RecordedCell(**names, key=path.parent.name)
    numbers = read_rows(path, cell, (*tables.ADDED, "int_rate"))
    assert all(
        table[name].null_count == rows.num_rows
        for table in (rows, numbers.table)
        for name in tables.ADDED
    )
    assert numbers.table["int_rate"].equals(rows["int_rate"])
    frame = read_frame(Layout(ROOT / "results" / "published"), [cell])
    table = autonomy_table(frame)
    texts = {column.key: table.text(0, c) for c, column in enumerate(table.columns)}
    assert [name for name, text in texts.items() if text == "n/a"] == ["int_eff", "mag_eff", "jump"]


# The table of branches: what is written comes back, and what is no such table is refused.


BRANCHED = BranchedCell(
    CellIdentity("goal1", "wasp", "full", "noisy", 0.4, 3),
    window=4,
    stride=2,
    tau_R=0.25,
    episodes=7,
)


def row(episode: int, t: int, branch: str, steps: int = 4) -> BranchRow:
    random = np.random.default_rng([episode, t, branch == ALONE])
    costs = random.random(steps) < 0.5
    return BranchRow(episode, t, branch, costs, 3 * costs, random.normal(size=steps), 0.5 + t, 1)


ROWS = [row(e, t, name) for e, t in ((0, 2), (0, 5), (3, 0)) for name in (ASSISTED, ALONE)] + [
    row(6, 9, ASSISTED, 2),
    row(6, 9, ALONE, 1),
]


def test_pairs_come_back_side_by_side_with_zeros_after_the_end(tmp_path):
    write_branches(tmp_path / "b.parquet", BRANCHED, ROWS)
    found = read_branches(tmp_path / "b.parquet")
    assert found.cell == BRANCHED
    assert found.episode.tolist() == [0, 0, 3, 6]
    assert found.t.tolist() == [2, 5, 0, 9]
    assert found.deviation.tolist() == [2.5, 5.5, 0.5, 9.5]
    assert found.gate.tolist() == [1, 1, 1, 1]
    for place, first in enumerate(range(0, len(ROWS), 2)):
        for name, each in ((ASSISTED, ROWS[first]), (ALONE, ROWS[first + 1])):
            steps = len(each.costs)
            assert found.cost[name][place].tolist() == [
                *map(float, each.costs),
                *[0.0] * (4 - steps),
            ]
            np.testing.assert_array_equal(
                found.reward[name][place, :steps], np.asarray(each.rewards, np.float32)
            )
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
    write_branches(path, BRANCHED, ROWS)
    pq.write_table(change(pq.read_table(path)), path)
    with pytest.raises(StoreError, match=what):
        read_branches(path)


def test_a_flipped_byte_among_the_rows_is_noticed_or_changes_nothing(tmp_path):
    path = tmp_path / "b.parquet"
    write_branches(path, BRANCHED, ROWS)
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


def test_former_names_of_branches_are_read(tmp_path):
    path, former = tmp_path / "b.parquet", tmp_path / "former.parquet"
    write_branches(path, BRANCHED, ROWS)
    table = pq.read_table(path)
    told = json.loads(table.schema.metadata[CELL_KEY])
    told["identity"] = {
        tables.RENAMED.get(name, name): value for name, value in told["identity"].items()
    }
    marks = {VERSION_KEY: b"1", CELL_KEY: json.dumps(told).encode()}
    pq.write_table(
        table.rename_columns(tables.RENAMED).replace_schema_metadata(marks),
        former,
        write_page_checksum=True,
    )
    found, now = read_branches(former), read_branches(path)
    assert found.cell == now.cell == BRANCHED
    assert (found.t.tolist(), found.deviation.tolist()) == (now.t.tolist(), now.deviation.tolist())
