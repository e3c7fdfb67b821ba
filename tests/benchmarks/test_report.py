"""Reading cells for a report, as a ratio to what has to be read at least, measured in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from tests.report.invented import invent, write
from wasp_cli.report.frame import Wanted, read_frame
from wasp_cli.report.main_table import main_table
from wasp_cli.store.tables import CellIdentity

CELLS = 100


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> list[Wanted]:
    folder = tmp_path_factory.mktemp("cells")
    episodes = [invent(e, 5, 0.2, 0.05, steps=250) for e in range(30)]
    return [write(folder, CellIdentity("goal1", "wasp", "full", "noisy", 0.2, seed), episodes) for seed in range(CELLS)]


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
