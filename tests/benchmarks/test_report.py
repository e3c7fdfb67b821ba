"""Reading cells for a report, as a ratio to what has to be read at least, measured in the same
run.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks import many

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def many_cells(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("many")
    many.write(folder)
    return folder


def measured(*arguments: object) -> dict[str, float]:
    """What `tests.benchmarks.many` prints, in a process of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.many", *map(str, arguments)]
    found: dict[str, float] = json.loads(
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    )
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
