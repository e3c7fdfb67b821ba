"""The rows of all cells in one file: the same frame, never a number that the cells no longer have."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.report.invented import invent, write_rows
from tests.store.former import with_former_names
from wasp_cli.report.stats import frame as frames
from wasp_cli.report.stats.frame import Frame, Wanted, read_frame
from wasp_cli.report.stats.kept import CELLS_KEY, VERSION_KEY
from wasp_cli.store.tables import SCHEMA

Grid = Callable[..., list[Wanted]]


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(frames, "LEAST_GAIN", 1)
    return tmp_path / "rows" / "x.parquet"


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The cells that are read from their own files."""
    found: list[Path] = []
    read = frames.read_numbers

    def recorded(path: Path, columns: tuple[str, ...]) -> object:
        found.append(path)
        return read(path, columns)

    monkeypatch.setattr(frames, "read_numbers", recorded)
    return found


def same(a: Frame, b: Frame) -> bool:
    if (a.order, a.missing, len(a.cells)) != (b.order, b.missing, len(b.cells)):
        return False
    for one, two in zip(a.cells, b.cells, strict=True):
        np.testing.assert_equal(dict(one.episodes), dict(two.episodes))
        np.testing.assert_equal(dict(one.pooled), dict(two.pooled))
        if (one.identity, one.severity, one.thresholds) != (two.identity, two.severity, two.thresholds):
            return False
    return True


def test_no_cell_is_opened_twice(grid: Grid, kept: Path, opened: list[Path]) -> None:
    wanted = grid(seeds=(0, 1))
    plain = read_frame(wanted)
    assert same(read_frame(wanted, kept), plain)
    opened.clear()
    assert same(read_frame(wanted, kept), plain)
    assert not opened
    assert same(read_frame(wanted[5:9], kept), read_frame(wanted[5:9]))


def test_few_cells_are_not_kept(grid: Grid, kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = grid(seeds=(0,))
    monkeypatch.setattr(frames, "LEAST_GAIN", len(wanted) + 1)
    read_frame(wanted, kept)
    assert not kept.exists()


def test_what_has_changed_since_is_read_again(grid: Grid, kept: Path, opened: list[Path], tmp_path: Path) -> None:
    wanted = grid(seeds=(0,))
    read_frame(wanted, kept)
    write_rows(wanted[0].path.parent, wanted[0].identity, [invent(1, 9, 0.5, 0.5)])
    wanted[1].path.unlink()
    content = wanted[2].path.read_bytes()
    column = pq.read_metadata(wanted[2].path).row_group(0).column(SCHEMA.get_field_index("return"))
    hit = column.data_page_offset + column.total_compressed_size - 1
    wanted[2].path.write_bytes(content[:hit] + bytes([content[hit] ^ 4]) + content[hit + 1 :])  # of the same size
    wanted[4] = replace(wanted[4], identity=wanted[3].identity)
    wanted[5] = replace(wanted[5], path=with_former_names(wanted[5].path, tmp_path / wanted[5].path.parent.name))
    opened.clear()
    frame = read_frame(wanted, kept)
    assert opened == [wanted[i].path for i in (0, 2, 4, 5)]
    assert frame.cells[0].count == 1
    reasons = {gap.label: (gap.reason, gap.damaged) for gap in frame.missing}
    assert reasons[wanted[1].label] == ("not computed yet", False)
    assert "damaged" in reasons[wanted[2].label][0]
    assert "holds another cell" in reasons[wanted[4].label][0]
    assert same(frame, read_frame(wanted))
    opened.clear()
    assert same(read_frame(wanted, kept), frame)  # now the new rows are kept; what did not read is tried again
    assert opened == [wanted[i].path for i in (2, 4)]


def test_bytes_that_were_touched_behind_its_back_are_read_again(grid: Grid, kept: Path, opened: list[Path]) -> None:
    wanted = grid(seeds=(0,))
    read_frame(wanted, kept)
    os.utime(wanted[3].path, ns=(1, 1))
    opened.clear()
    read_frame(wanted, kept)
    assert opened == [wanted[3].path]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-50])


def flip(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:300] + bytes([content[300] ^ 4]) + content[301:])


def text(path: Path) -> None:
    path.write_text("no table")


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def newer(path: Path) -> None:
    marked(path, {VERSION_KEY: b"99"})


def no_cells(path: Path) -> None:
    marked(path, {CELLS_KEY: b"[]"})


def cells_of_no_form(path: Path) -> None:
    marked(path, {CELLS_KEY: b'[{"place": 7}, 8]'})


def too_many_rows(path: Path) -> None:
    cells = json.loads(pq.read_schema(path).metadata[CELLS_KEY])
    cells[0]["rows"] += 1
    marked(path, {CELLS_KEY: json.dumps(cells).encode()})


def other_columns(path: Path) -> None:
    table = pq.read_table(path)
    pq.write_table(table.drop_columns(["cost"]), path)


def other_types(path: Path) -> None:
    table = pq.read_table(path)
    place = table.schema.get_field_index("cost")
    pq.write_table(table.set_column(place, "cost", table["cost"].cast(pa.string())), path)


def marked(path: Path, marks: dict[bytes, bytes]) -> None:
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({**table.schema.metadata, **marks}), path)


@pytest.mark.parametrize(
    "harm",
    [cut, flip, text, folder, newer, no_cells, cells_of_no_form, too_many_rows, other_columns, other_types],
    ids=lambda f: f.__name__,
)
def test_a_file_of_no_use_changes_nothing(grid: Grid, kept: Path, opened: list[Path], harm: Callable[[Path], None]) -> None:
    wanted = grid(seeds=(0,))
    plain = read_frame(wanted, kept)
    harm(kept)
    opened.clear()
    assert same(read_frame(wanted, kept), plain)
    assert len(opened) == len(wanted)


def test_a_link_is_neither_read_nor_written_through(grid: Grid, kept: Path, opened: list[Path], tmp_path: Path) -> None:
    wanted = grid(seeds=(0,))
    read_frame(wanted, kept)
    outside = kept.rename(tmp_path / "outside.parquet")
    before = outside.read_bytes()
    kept.symlink_to(outside)
    opened.clear()
    read_frame(wanted, kept)
    assert len(opened) == len(wanted)
    assert outside.read_bytes() == before


def test_a_folder_that_cannot_be_written_is_no_error(grid: Grid, tmp_path: Path, kept: Path) -> None:
    kept.parent.write_text("a file in its place")
    wanted = grid(seeds=(0,))
    assert same(read_frame(wanted, kept), read_frame(wanted))
