from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.plans import plans_of
from wasp_cli.errors import StoreError
from wasp_cli.metrics.episode import Plans, Trajectory, episode_metrics
from wasp_cli.store import tables
from wasp_cli.store.tables import PLANNED, STEP, VERSION_KEY, CellIdentity, Thresholds, read_episodes, read_steps, same_rows, write_cell

CELL = CellIdentity("goal1", "wasp", "full", "noisy", 0.4, 3)


def invent(seed: int, steps: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    acts = rng.random(steps) < 0.5
    a_h = rng.uniform(-1, 1, (steps, 2))
    cost_env = rng.integers(0, 3, steps)
    return Trajectory(
        reward=rng.normal(size=steps),
        cost=cost_env > 0,
        cost_env=cost_env,
        env_steps=np.full(steps, 4),
        goals=rng.integers(0, 2, steps),
        a_h=a_h,
        a=np.where(acts[:, None], -a_h, a_h),
        gate=np.where(acts, 1, 0).astype(np.int8),
        g_cost=rng.random(steps),
        g_return=rng.random(steps),
        delta_g=np.where(acts, 0.5, np.nan),
        signal=np.full(steps, np.nan),
        plans=plans_of(np.where(acts, 0.25, np.nan)),
    )


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def make(name: str = "cell.parquet", cell: CellIdentity = CELL, seed: int = 0, slowness: float = 1.0) -> Path:
        trajectories = [invent(seed, 5), invent(seed + 1, 1), invent(seed + 2, 9)]
        rows = [episode_metrics(trajectory, 3, 25.0) for trajectory in trajectories]
        times = [slowness * np.arange(1.0, trajectory.steps + 1) for trajectory in trajectories]
        write_cell(tmp_path / name, cell, trajectories, rows, Thresholds(tau_c=0.3, tau_r=0.41), times, [11, 12, 13])
        return tmp_path / name

    return make


def test_episodes_round_trip(write: Callable[..., Path]) -> None:
    table = read_episodes([write()])
    assert table.num_rows == 3
    assert "steps" not in table.column_names
    assert "decision_ms" not in table.column_names
    rows = table.to_pylist()
    assert [row["episode_seed"] for row in rows] == [11, 12, 13]
    assert [row["decisions"] for row in rows] == [5, 1, 9]
    assert {(row["task"], row["method"], row["assistant_variant"], row["variant"], row["value"], row["seed"]) for row in rows} == {
        ("goal1", "wasp", "full", "noisy", 0.4, 3)
    }
    assert (rows[0]["tau_c"], rows[0]["tau_r"], rows[0]["tau_q"]) == (0.3, 0.41, None)
    assert (rows[0]["decision_p50_ms"], rows[0]["decision_p95_ms"]) == (3.0, pytest.approx(4.8))
    wanted = episode_metrics(invent(0, 5), 3, 25.0)
    assert (rows[0]["return"], rows[0]["mag_int"], rows[0]["case2"]) == (wanted.return_, wanted.mag_int, wanted.case2)
    assert rows[1]["smoothness"] is None


def test_steps_round_trip(write: Callable[..., Path]) -> None:
    steps = read_steps(write()).to_pylist()
    assert [(step["episode"], step["t"]) for step in steps] == [(0, t) for t in range(5)] + [(1, 0)] + [(2, t) for t in range(9)]
    episode = invent(2, 9)
    for t, step in enumerate(steps[6:]):
        assert step["reward"] == np.float32(episode.reward[t])
        assert step["a"] == episode.a[t].astype(np.float32).tolist()
        assert step["a_h"] == episode.a_h[t].astype(np.float32).tolist()
        assert step["deviation"] == np.float32(episode.deviation[t])
        assert step["cost"] == (step["cost_env"] > 0)
        assert step["g_return"] == np.float32(episode.g_return[t])
        assert step["signal"] is None
        planned = ("plan", "safe", "case2", "plan_cost", "plan_return", "alone_cost", "alone_return")
        if not step["gate"]:
            assert all(step[name] is None for name in planned)
            continue
        assert step["safe"] == [17] * 4
        assert step["case2"] == [True, False, False, False]
        assert step["plan"] == [0.0, 0.25, 0.5, 0.75, 1.0, 1.25]
        assert [step[name] for name in planned[3:]] == [t / 8 + i for i in range(4)]


def test_the_unimpaired_operator_has_no_value(write: Callable[..., Path]) -> None:
    table = read_episodes([write(cell=CellIdentity("goal1", "expert", "full", "none", None, 0))])
    assert table["value"].null_count == 3


def test_many_cells_in_order(write: Callable[..., Path]) -> None:
    paths = [write(f"{seed}.parquet", CellIdentity("goal1", "ida", "full", "laggy", 0.5, seed), seed) for seed in (2, 0, 1)]
    assert read_episodes(paths)["seed"].to_pylist() == [2] * 3 + [0] * 3 + [1] * 3
    assert read_episodes([]).num_rows == 0


def test_same_input_same_bytes(write: Callable[..., Path]) -> None:
    assert write("a.parquet").read_bytes() == write("b.parquet").read_bytes()


def test_same_rows_leaves_timing_out(write: Callable[..., Path]) -> None:
    first = write("a.parquet")
    assert same_rows(first, write("b.parquet", slowness=2.0))
    assert not same_rows(first, write("c.parquet", seed=1))
    assert not same_rows(first, write("d.parquet", cell=CellIdentity("goal1", "wasp", "full", "noisy", 0.6, 3)))


def test_every_column_is_written_from_its_own_field() -> None:
    """The schema and the dataclasses name the same things, so that a new metric cannot be forgotten in one of them."""
    metrics = {"return" if name == "return_" else name for name in tables.EpisodeMetrics.__dataclass_fields__}
    assert {field.name for field in tables.METRICS} == metrics
    assert {field.name for field in tables.STEP} == (set(Trajectory.__dataclass_fields__) - {"plans"}) | {"t", "deviation", *PLANNED}
    assert set(PLANNED.values()) == set(Plans.__dataclass_fields__)


def test_truncated_file(write: Callable[..., Path]) -> None:
    path = write()
    path.write_bytes(path.read_bytes()[:-100])
    for read in (lambda: read_episodes([path]), lambda: read_steps(path)):
        with pytest.raises(StoreError, match=r"cell\.parquet is damaged"):
            read()


@pytest.mark.parametrize("content", [b"", b"PAR1", b"not a table at all, only text"])
def test_not_parquet(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "cell.parquet"
    path.write_bytes(content)
    with pytest.raises(StoreError, match=r"cell\.parquet is damaged"):
        read_episodes([path])


def test_a_flipped_bit_never_becomes_a_number(write: Callable[..., Path]) -> None:
    whole, path = write("whole.parquet"), write("hit.parquet")
    content = path.read_bytes()
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")  # has no checksum; the pages before it have
    noticed = 0
    for place in range(0, footer, 13):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        try:
            assert same_rows(path, whole)
        except StoreError:
            noticed += 1
    assert noticed > 100


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"nowhere\.parquet does not exist"):
        read_episodes([tmp_path / "nowhere.parquet"])


def test_newer_version_is_refused(write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "SCHEMA", tables.SCHEMA.with_metadata({tables.VERSION_KEY: b"3"}))
    path = write()
    with pytest.raises(StoreError, match="table version 3, this wasp reads up to 2") as caught:
        read_episodes([path])
    assert caught.value.hint is not None
    assert "upgrade" in caught.value.hint


def test_another_parquet_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.parquet"
    pq.write_table(pa.table({"episode": [1]}), path)
    with pytest.raises(StoreError, match="not the table of a cell"):
        read_episodes([path])


def test_no_partial_file(write: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("wasp_cli.store.parquet.pq.write_table", fail)
    with pytest.raises(StoreError, match="No space left on device"):
        write()
    assert not (tmp_path / "cell.parquet").exists()


def test_lengths_must_agree(tmp_path: Path) -> None:
    trajectory = invent(0, 3)
    with pytest.raises(ValueError, match="1 trajectories, 0 rows"):
        write_cell(tmp_path / "x.parquet", CELL, [trajectory], [], Thresholds(), [np.ones(3)], [0])


def test_duckdb_unnests_the_steps(write: Callable[..., Path]) -> None:
    import duckdb

    found = duckdb.sql(f"select episode, unnest(steps, recursive := true) from '{write()}'").fetchall()
    assert len(found) == 15


def test_a_table_of_the_first_version_reads_with_nulls(write: Callable[..., Path], tmp_path: Path) -> None:
    """Version 1 had `safe` as one number, `case2_share`, and nothing else of a plan."""
    whole = pq.read_table(write())
    steps = whole["steps"].combine_chunks()
    flat = steps.flatten()
    kept = {field.name: flat.field(field.name) for field in STEP if field.name not in (*PLANNED, "g_return")}
    kept |= {"safe": pa.array([3] * len(flat), pa.int16()), "case2_share": pa.array([0.5] * len(flat), pa.float32())}
    old = pa.ListArray.from_arrays(steps.offsets, pa.StructArray.from_arrays(list(kept.values()), names=list(kept)))
    table = whole.set_column(whole.schema.get_field_index("steps"), "steps", old).replace_schema_metadata({VERSION_KEY: b"1"})
    path = tmp_path / "old.parquet"
    pq.write_table(table, path)
    assert read_episodes([path]).num_rows == 3
    again = read_steps(path)
    assert again["reward"].equals(read_steps(write("new.parquet"))["reward"])
    assert all(again[name].null_count == again.num_rows for name in (*PLANNED, "g_return"))
