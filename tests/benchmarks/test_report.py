"""Reading cells for a report, as a ratio to what has to be read at least, measured in the same run."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from tests.benchmarks import many
from tests.report.invented import invent, write
from wasp_cli.report.stats import Wanted, read_frame
from wasp_cli.report.tables.main import main_table
from wasp_cli.store.tables import STEPS_FILE, CellIdentity

CELLS = 100
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def cells(tmp_path_factory) -> list[Wanted]:
    folder = tmp_path_factory.mktemp("cells")
    episodes = [invent(e, 5, 0.2, 0.05, steps=250) for e in range(30)]
    return [write(folder, CellIdentity("goal1", "wasp", "full", "noisy", 0.2, seed), episodes) for seed in range(CELLS)]


@pytest.fixture(scope="module")
def many_cells(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("many")
    many.write(folder)
    return folder


def seconds(work: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def test_a_report_does_not_read_the_steps(benchmark, cells):
    paths = [path for cell in cells for path in (cell.path, cell.path.with_name(STEPS_FILE))]
    with_steps = min(seconds(lambda: [pq.read_table(path) for path in paths]) for _ in range(3))
    benchmark(lambda: main_table(read_frame(cells)))
    assert benchmark.stats.stats.min < 2 * with_steps


def test_writing_a_cell_costs_little_beside_its_bytes(benchmark, tmp_path):
    episodes = [invent(e, 5, 0.2, 0.05, steps=250) for e in range(30)]
    identity = CellIdentity("goal1", "wasp", "full", "noisy", 0.2, 0)
    path = write(tmp_path, identity, episodes).path
    tables = [pq.read_table(file) for file in (path, path.with_name(STEPS_FILE))]
    bare = min(seconds(lambda: [pq.write_table(each, tmp_path / "bare.parquet", compression="zstd") for each in tables]) for _ in range(3))
    benchmark(lambda: write(tmp_path, identity, episodes))
    # The rest are the measures of 30 episodes and two fsyncs.
    assert benchmark.stats.stats.min < 20 * bare


def measured(*arguments: object) -> dict[str, float]:
    """What `tests.benchmarks.many` prints, in a process of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.many", *map(str, arguments)]
    found: dict[str, float] = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
    return found


def test_a_million_episodes_in_five_thousand_cells(benchmark, many_cells):
    """All tables and figures of a large grid; DuckDB pools the same columns of the same files."""
    measured(many_cells)  # so that the files are in memory
    peers = [measured(many_cells, "duckdb") for _ in range(2)]
    found = benchmark.pedantic(lambda: measured(many_cells), rounds=1)
    duckdb = min(peers, key=lambda each: each["cpu"])
    benchmark.extra_info.update(found=found, duckdb=duckdb)
    assert (found["cells"], found["episodes"], found["figures"]) == (5037, 1_007_400, 6)
    assert found["peak"] < 1e9
    assert found["return"] == pytest.approx(duckdb["return"], rel=1e-12)
    assert found["read"] < 4 * duckdb["read"]
