"""Figure 3: as a table and as a picture."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.report.branched import with_invented_branches
from tests.report.invented import write_grid
from wasp_cli.report.figures import necessity_figure
from wasp_cli.report.stats import Frame, Wanted, read_frame, with_branches
from wasp_cli.report.tables.comparison import necessity_table
from wasp_cli.report.tables.table import Table

Grid = Callable[..., list[Wanted]]


def frame_of(wanted: list[Wanted]) -> Frame:
    return with_branches(read_frame(wanted), wanted)


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Frame:
    return frame_of(with_invented_branches(write_grid(tmp_path_factory.mktemp("grid"), ablations=("safety-only",))))


def table_of(frame: Frame) -> Table:
    table = necessity_table(frame)
    assert table is not None
    return table


def row(table: Table, method: str) -> dict[str, float | None]:
    values = next(row.values for row in table.rows if row.labels[1].startswith(method))
    return {column.key: value.mean for column, value in zip(table.columns, values, strict=True)}


def test_a_row_is_the_mean_over_seeds_of_its_cells(judged: Frame) -> None:
    found = row(table_of(judged), "IDA")
    cells = [cell for cell in judged.cells if cell.identity.method == "ida"]
    by_seed = [np.mean([cell.pooled["uir"] for cell in cells if cell.identity.seed == seed]) for seed in (0, 1, 2)]
    assert found["uir"] == pytest.approx(np.mean(by_seed))
    assert found["interventions"] == sum(cell.episodes["intervened"].sum() for cell in cells)
    assert found["branched"] == found["interventions"]
    assert "Human-only" not in {label for row in table_of(judged).rows for label in row.labels}


def test_a_sample_is_told_and_so_is_a_small_one(grid: Grid) -> None:
    table = table_of(frame_of(with_invented_branches(grid(seeds=(0,)), stride=12)))
    found = row(table, "WASP")
    assert found["interventions"] == 4 * 20
    assert found["branched"] == 4 * 2
    assert any(note.startswith("Fewer than 30 interventions were branched of IDA, Diffusion, SafeRL-Res, WASP:") for note in table.notes)


def test_rows_without_all_branches_are_partial_and_never_best(grid: Grid) -> None:
    wanted = with_invented_branches(grid(seeds=(0, 1)))
    table = table_of(frame_of(wanted))
    best = {table.rows[r].labels[1] for r, c in table.marks if table.columns[c].key == "uir"}
    assert best == {"WASP"}
    gone = next(cell.branches for cell in wanted if cell.identity.method == "wasp")
    gone.path.unlink()
    partial = table_of(frame_of(wanted))
    assert "WASP [7 of 8 cells]" in {row.labels[1] for row in partial.rows}
    assert not any(partial.rows[r].labels[1].startswith("WASP") for r, _ in partial.marks)
    assert any(note.startswith("INCOMPLETE: 1 cell has no counterfactual branches") for note in partial.notes)


def test_without_counterfactuals_there_is_neither_table_nor_figure(grid: Grid, tmp_path: Path) -> None:
    frame = frame_of(grid(seeds=(0,)))
    assert necessity_table(frame) is None
    assert necessity_figure(frame, tmp_path / "none") == []


def test_the_figure_says_what_it_is_made_from_and_is_the_same_twice(judged: Frame, tmp_path: Path) -> None:
    one, other = tmp_path / "a", tmp_path / "b"
    one.mkdir()
    other.mkdir()
    files = necessity_figure(judged, one)
    assert [path.name for path in files] == ["figure3.png", "figure3.svg"]
    assert [path.read_bytes() for path in files] == [path.read_bytes() for path in necessity_figure(judged, other)]
    drawn = files[1].read_text(encoding="utf-8")
    for text in ("IDA", "SafeRL-Res", "Goal1", "n = ", "UIR", "hollow: branches swapped", "share of the next 4 decisions", "no cost"):
        assert text in drawn
    with Image.open(files[0]) as picture:
        assert picture.width >= 1200
        assert len(set(picture.convert("L").resize((200, 80)).tobytes())) > 10
