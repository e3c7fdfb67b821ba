"""What is kept of rows between commands is read in place of the cells, and never believed where a
cell has changed.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tests.compare.two_runs import write_results
from wasp_cli.cells import kept_rows, read
from wasp_cli.cells.asked import Asked
from wasp_cli.cells.read import CellsRead, read_cells, rows_of
from wasp_cli.cells.table import CellTable
from wasp_cli.errors import StoreError
from wasp_cli.plan import index
from wasp_cli.store import schema
from wasp_cli.store.layout import Layout


@pytest.fixture(autouse=True)
def keep_also_few_and_new_cells(monkeypatch):
    monkeypatch.setattr(kept_rows, "LEAST_NEW", 1)
    monkeypatch.setattr(index, "RACY", 0.0)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """A cache folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "wasp" / "kept"


@pytest.fixture
def results(tmp_path) -> Asked:
    return write_results(tmp_path / "results")


def same(one: CellsRead, other: CellsRead) -> bool:
    return (
        one.missing == other.missing
        and one.table.cells == other.table.cells
        and one.table.thresholds == other.table.thresholds
        and one.table.counts.tolist() == other.table.counts.tolist()
        and all(
            np.array_equal(one.table.episodes(name), other.table.episodes(name), equal_nan=True)
            for name in one.table.names
        )
    )


def forbid_reading_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: object) -> None:
        raise StoreError(f"{path} was read")

    monkeypatch.setattr(read, "read_rows", refuse)


def test_cells_that_were_read_are_not_opened_again(results, monkeypatch):
    first = read_cells(results.layout, results.cells)
    forbid_reading_cells(monkeypatch)
    assert same(read_cells(results.layout, results.cells), first)
    part = read_cells(results.layout, results.cells[2:4])
    assert part.table.cells == first.table.cells[2:4]


def test_a_cell_that_changed_is_read_again(results):
    first = read_cells(results.layout, results.cells)
    one, other = (rows_of(results.layout, cell) for cell in results.cells[:2])
    before = one.stat()
    one.write_bytes(bytes(before.st_size))
    os.utime(one, ns=(before.st_atime_ns, before.st_mtime_ns))
    other.unlink()
    found = read_cells(results.layout, results.cells)
    damaged, absent = (
        next(gap for gap in found.missing if gap.cell == cell) for cell in results.cells[:2]
    )
    assert damaged.damaged
    assert not absent.damaged
    assert found.table.cells == first.table.cells[2:]


def test_a_folder_in_the_place_of_another_is_read(results, tmp_path):
    read_cells(results.layout, results.cells)
    shutil.rmtree(results.layout.root)
    other = write_results(results.layout.root, seeds=[3])
    (tmp_path / "cache").rename(tmp_path / "aside")
    expected = read_cells(other.layout, other.cells)
    shutil.rmtree(tmp_path / "cache")
    (tmp_path / "aside").rename(tmp_path / "cache")
    assert same(read_cells(other.layout, other.cells), expected)


def test_a_copied_folder_is_read_from_its_cells(results, tmp_path):
    first = read_cells(results.layout, results.cells)
    copy = Layout(Path(shutil.copytree(results.layout.root, tmp_path / "copy")))
    one, other = (rows_of(copy, cell) for cell in results.cells[:2])
    one.write_bytes(other.read_bytes())
    found = read_cells(copy, results.cells)
    assert "another cell" in found.missing[0].reason
    assert found.table.cells == first.table.cells[1:]


def test_another_cell_under_the_same_key_is_refused(results):
    read_cells(results.layout, results.cells)
    one, other = results.cells[:2]
    swapped = type(one)(**{**vars(other), "key": one.key})
    (gap,) = read_cells(results.layout, [swapped]).missing
    assert "another cell" in gap.reason


def test_a_damaged_file_changes_no_number(results, folder):
    first = read_cells(results.layout, results.cells)
    (path,) = folder.glob("rows-*")
    whole = path.read_bytes()
    for place in range(0, len(whole), len(whole) // 20):
        data = bytearray(whole)
        data[place] ^= 1
        path.write_bytes(data)
        assert same(read_cells(results.layout, results.cells), first)
        path.write_bytes(whole[:place])
        assert same(read_cells(results.layout, results.cells), first)


def test_rows_without_a_column_that_was_added_since_are_read_again(results, monkeypatch):
    less = read.COLUMNS[1:]
    with monkeypatch.context() as before:
        before.setattr(kept_rows, "ROWS", pa.schema([schema.SCHEMA.field(name) for name in less]))
        before.setattr(read, "COLUMNS", less)
        before.setattr(read, "table_of", lambda found: CellTable((), (), {}))
        read_cells(results.layout, results.cells)
    found = read_cells(results.layout, results.cells)
    assert not found.missing
    assert read.COLUMNS[0] in found.table.names


def test_a_few_new_cells_are_not_kept(results, folder, monkeypatch):
    monkeypatch.setattr(kept_rows, "LEAST_NEW", len(results.cells) + 1)
    read_cells(results.layout, results.cells)
    assert not list(folder.glob("rows-*"))


def test_cells_that_were_removed_are_not_kept(results, folder):
    read_cells(results.layout, results.cells)
    (path,) = folder.glob("rows-*")
    before = path.stat().st_size
    for cell in results.cells[1:]:
        shutil.rmtree(results.layout.artifact("evaluate", cell.key))
    first = rows_of(results.layout, results.cells[0])
    first.write_bytes(first.read_bytes())  # its times are new: it is read and kept again
    read_cells(results.layout, results.cells)
    assert path.stat().st_size < before
