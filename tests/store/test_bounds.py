"""Small files that stand for more rows than any plan has: every reader refuses them before it reads."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from difflib import SequenceMatcher
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.commands import run_here
from tests.view.conftest import brought
from wasp_cli import errors
from wasp_cli.errors import LONGEST_NAME, StoreError, WaspError
from wasp_cli.notebook.results import open_results
from wasp_cli.report.explain.stored import read_episode
from wasp_cli.store import bounds
from wasp_cli.store.bounds import MOST_EPISODES, require_size
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.store.numbers import read_numbers
from wasp_cli.store.tables import EPISODES_FILE, STEPS_FILE
from wasp_cli.view.site import site_of

CELL = "goal1 s1 human noisy=0.45"


def inflated(path: Path, rows: int) -> Path:
    """The first row of a table again and again, which Parquet writes in next to nothing."""
    table = pq.read_table(path).slice(0, 1)
    some = table.take(pa.array(np.zeros(min(rows, 1_000_000), np.int64)))
    with pq.ParquetWriter(path, table.schema, compression="zstd", write_page_checksum=True) as writer:
        for _ in range(0, rows, len(some)):
            writer.write_table(some, row_group_size=len(some))
    return path


@pytest.fixture
def results(tmp_path) -> Path:
    return brought(tmp_path / "results", CELL)


def file_of(results: Path, name: str) -> Path:
    (path,) = results.glob(f"store/evaluate/*/{name}")
    return path


def test_what_a_run_writes_is_read(results):
    sizes = [require_size(path) for path in (file_of(results, EPISODES_FILE), *results.rglob("*.parquet"))]
    assert sizes == [None] * len(sizes)
    assert open_results(results).episodes().num_rows > 0


READERS: dict[str, Callable[[Path], object]] = {
    "explain": lambda results: read_episode(find_cell(Layout(results), CELL), 0),
    "notebook": lambda results: open_results(results).episodes(),
}


@pytest.mark.parametrize("reader", READERS)
def test_readers_refuse_too_many_episodes(reader, results):
    path = inflated(file_of(results, EPISODES_FILE), MOST_EPISODES + 1)
    assert read_numbers(path, ("return",)) is None
    with pytest.raises(StoreError, match=r"episodes\.parquet has 100,001 rows, and a cell has at most 100,000 episodes"):
        READERS[reader](results)


def test_readers_refuse_too_many_steps(results, monkeypatch):
    monkeypatch.setattr(bounds, "MOST_VALUES", 1_000_000)
    require_size(file_of(results, EPISODES_FILE))
    inflated(file_of(results, STEPS_FILE), 100_000)
    with pytest.raises(StoreError, match=r"_steps\.pq has 100,000 rows with .* numbers"):
        read_episode(find_cell(Layout(results), CELL), 0)


@pytest.mark.parametrize("command", [["explain"], ["note"], ["view"]], ids=lambda each: each[0])
def test_a_name_of_any_length_costs_nothing(command, results, monkeypatch):
    """Comparing 60,000 characters with the names of a store took 17 s of CPU: they are compared with none."""
    name = "goal1 s1 human noisy " * 3000

    def compared(_: object, one: str, other: str) -> SequenceMatcher[str]:
        assert max(len(one), len(other)) <= LONGEST_NAME
        return SequenceMatcher(None, one, other)

    monkeypatch.setattr(errors, "difflib", SimpleNamespace(SequenceMatcher=compared))
    if command == ["view"]:
        with pytest.raises(WaspError, match="unknown cell") as caught:
            site_of(results).one(name)
        assert "this one has 62999" in str(caught.value.hint)
        return
    done = run_here(*command, name, *(["text"] if command == ["note"] else []), "--results", results, columns=100)
    assert done.exit_code == 2, done.stderr[-500:]
    assert "did you mean" not in done.stderr


def test_a_bomb_costs_a_report_no_memory(results, tmp_path):
    """The report names the file and goes on with the rest, in a process that may not have more memory than such a report needs."""
    bomb = inflated(file_of(results, EPISODES_FILE), 20_000_000)
    assert bomb.stat().st_size < 10e6
    other = brought(tmp_path / "other", "goal1 s1 wasp noisy=0.45")
    shutil.copytree(other / "store", results / "store", dirs_exist_ok=True)
    code = (
        "import sys; from pathlib import Path; import wasp_cli\n"
        "from wasp_cli.view.site import site_of\n"
        "shown = site_of(Path(sys.argv[1])).cells.wait()\n"
        "print(sorted((each.reason, each.episodes) for each in shown.values()))\n"
        "peak = next(line for line in open('/proc/self/status') if line.startswith('VmHWM'))\n"  # ru_maxrss begins with the parent's
        "print(int(peak.split()[1]) // 1024)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(results)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told, megabytes = done.stdout.splitlines()
    assert "has 20,000,000 rows" in told
    assert int(megabytes) < 1000
