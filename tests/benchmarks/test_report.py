"""Reading cells for a report, as a ratio to what has to be read at least, measured in the same run."""

from __future__ import annotations

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
from wasp_cli.report.stats.frame import COLUMNS, Wanted, read_frame
from wasp_cli.report.tables.main import main_table
from wasp_cli.store.tables import CellIdentity

CELLS = 100
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> list[Wanted]:
    folder = tmp_path_factory.mktemp("cells")
    episodes = [invent(e, 5, 0.2, 0.05, steps=250) for e in range(30)]
    return [write(folder, CellIdentity("goal1", "wasp", "full", "noisy", 0.2, seed), episodes) for seed in range(CELLS)]


@pytest.fixture(scope="module")
def many_cells(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("many")
    many.write(folder)
    return folder


def seconds(work: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def test_a_report_does_not_read_the_steps(benchmark: Any, cells: list[Wanted]) -> None:
    with_steps = min(seconds(lambda: [pq.read_table(cell.path) for cell in cells]) for _ in range(3))
    benchmark(lambda: main_table(read_frame(cells)))
    assert benchmark.stats.stats.min < 2 * with_steps


def test_writing_a_cell_costs_little_beside_its_bytes(benchmark: Any, tmp_path: Path) -> None:
    episodes = [invent(e, 5, 0.2, 0.05, steps=250) for e in range(30)]
    identity = CellIdentity("goal1", "wasp", "full", "noisy", 0.2, 0)
    table = pq.read_table(write(tmp_path, identity, episodes).path)
    bare = min(seconds(lambda: pq.write_table(table, tmp_path / "bare.parquet", compression="zstd")) for _ in range(3))
    benchmark(lambda: write(tmp_path, identity, episodes))
    # The rest are the measures of 30 episodes and one fsync.
    assert benchmark.stats.stats.min < 20 * bare


def test_a_million_episodes_in_five_thousand_cells(benchmark: Any, many_cells: Path) -> None:
    """On two idle cores it is to take less than ten seconds; here it is held against reading the same columns one file after the other."""
    paths = [cell.path for cell in many.wanted(many_cells)]
    bare = seconds(lambda: [pq.read_table(path, columns=list(COLUMNS), use_threads=False) for path in paths])
    command = [sys.executable, "-m", "tests.benchmarks.many", str(many_cells)]
    done = benchmark.pedantic(lambda: subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True), rounds=1)
    found = json.loads(done.stdout)
    benchmark.extra_info.update(found, bare=bare)
    assert (found["cells"], found["episodes"]) == (5037, 1_007_400)
    assert found["peak"] < 1e9
    assert found["all"] < 1.5 * bare
