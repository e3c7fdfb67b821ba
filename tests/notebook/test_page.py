"""What docs/results.md shows is run: its lines over the small run that is checked in, its readers over cells of today's layout."""

import contextlib
import io
import re
import shlex
import shutil
from pathlib import Path

import duckdb
import pytest

from tests.store.folders import folder_of_cells
from tests.test_docs import ROOT, blocks

PAGE = ROOT / "docs" / "results.md"
LINES = [line[2:] for block in blocks(PAGE, "console") for line in block.splitlines() if line.startswith("$ python")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A current folder as after a run in a checkout."""
    place = tmp_path_factory.mktemp("page")
    shutil.copytree(ROOT / "tests" / "golden" / "store", place / "results")
    shutil.copytree(ROOT / "results" / "published", place / "results" / "published")
    return place


@pytest.mark.parametrize("line", LINES)
def test_lines_run(line: str, folder: Path) -> None:
    pytest.importorskip("pandas")
    *python, program = shlex.split(line)
    assert python == ["python", "-c"]
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(program, {})
    assert printed.getvalue().strip() not in ("", "0", "[]")


def test_frames_are_made_as_shown(folder: Path) -> None:
    """The first Python block, but for its replay: the models of this run are not checked in."""
    pytest.importorskip("pandas")
    block = blocks(PAGE, "python")[0].partition("\nfor frame")[0]
    printed: list[object] = []
    with contextlib.chdir(folder):
        exec(block, {"print": printed.append})
    assert str(printed[0]).count("laggy") == 5  # Human-only, IDA, Diffusion, WASP and an ablation


def test_other_readers_read_the_files_as_shown(tmp_path: Path) -> None:
    for module in ("pandas", "polars"):
        pytest.importorskip(module)
    layout = folder_of_cells(tmp_path / "results", method="wasp")
    text = next(block for block in blocks(PAGE, "python") if "read_parquet" in block)
    imports, *readers = [line for line in text.splitlines() if line]
    names: dict[str, object] = {}
    exec(imports, names)
    assert len(readers) == 3
    with contextlib.chdir(tmp_path):
        assert [len(eval(line, names)) for line in readers] == [9, 9, 9]
        (sql,) = blocks(PAGE, "sql")
        episodes, steps = (duckdb.sql(query).fetchall() for query in re.findall(r"[^;]+;", sql))
    assert [row[:2] for row in episodes] == [("goal1", "wasp")]
    assert len({row[0] for row in steps}) == 3
    assert layout.store.is_dir()
