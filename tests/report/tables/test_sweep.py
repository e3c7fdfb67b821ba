"""The tables of a sweep against numbers worked out by hand (tests/report/swept.py says how)."""

import csv
import io
from pathlib import Path

import pytest

from tests.report.swept import NUMBERS, invent_sweep
from wasp_cli.report.sweep import SweepReport
from wasp_cli.report.tables.by_axis import CHOICE, DIFFERENCE, UNTOUCHED_NOTE, Swept, lines, sweep_operator_table, sweep_table
from wasp_cli.report.tables.table import Table
from wasp_cli.store.tables import CellIdentity

KEY = "diffusion.ratio"
LOST = CellIdentity("goal1", "diffusion", "full", "noisy", 0.6, 1)


@pytest.fixture
def swept(tmp_path: Path) -> list[Swept]:
    return invent_sweep(tmp_path)


def printed(table: Table, *columns: str) -> list[tuple[str, ...]]:
    """The labels of every row, and some of its cells without the spread."""
    shown = [(c, column) for c, column in enumerate(table.columns) if column.key in columns]
    return [(*row.labels, *(column.cell(row.values[c], spread=False) for c, column in shown)) for row in table.rows]


def test_a_row_for_each_value_and_one_for_what_the_setting_does_not_touch(swept: list[Swept]) -> None:
    table = sweep_table(KEY, swept)
    assert table.labels == ("Task", "Method", KEY)
    # Two operators and two seeds: a return of 7 and 6, 2 of 2 and 2 of 2 successes, and one goal more with every value.
    assert printed(table, "return", "success", "int_rate", "mag", "mag_int") == [
        ("Goal1", "Human-only", "-", "6.50", "100.0", "0.00", "0.00", "n/a"),
        ("Goal1", "Diffusion", "0", "6.50 (+0.00)", "100.0 (+0.0)", "0.10", "0.06", "0.62"),
        ("Goal1", "Diffusion", "0.20", "7.50 (+1.00)", "100.0 (+0.0)", "0.20", "0.12", "0.62"),
        ("Goal1", "Diffusion", "0.6", "8.50 (+2.00)", "100.0 (+0.0)", "0.30", "0.19", "0.62"),
    ]
    assert {UNTOUCHED_NOTE, DIFFERENCE} <= set(table.meanings)
    assert CHOICE in table.notes


def test_a_row_for_each_operator_tells_what_a_value_gains_and_costs(tmp_path: Path) -> None:
    # The fourth operator reaches 1 and 2 goals alone, where three are a success.
    conditions = (("laggy", 0.5), ("laggy", 0.7), ("noisy", 0.2), ("noisy", 0.6))
    table = sweep_operator_table(KEY, invent_sweep(tmp_path, conditions=conditions))
    assert [column.key for column in table.columns] == ["return", "success", "cost"]
    found = printed(table, "return", "success", "cost")
    assert len(found) == 4 * 4
    assert found[0] == ("Goal1", "Laggy 0.5", "Human-only", "-", "7.00", "100.0", "50.00")
    assert found[1] == ("Goal1", "Laggy 0.5", "Diffusion", "0", "7.00 (+0.00)", "100.0 (+0.0)", "50.00 (+0.00)")
    assert found[3] == ("Goal1", "Laggy 0.5", "Diffusion", "0.6", "9.00 (+2.00)", "100.0 (+0.0)", "0.00 (-50.00)")
    assert [row[:6] for row in found[12:]] == [
        ("Goal1", "Noisy 0.6", "Human-only", "-", "4.00", "0.0"),
        ("Goal1", "Noisy 0.6", "Diffusion", "0", "4.00 (+0.00)", "0.0 (+0.0)"),
        ("Goal1", "Noisy 0.6", "Diffusion", "0.20", "5.00 (+1.00)", "50.0 (+50.0)"),
        ("Goal1", "Noisy 0.6", "Diffusion", "0.6", "6.00 (+2.00)", "100.0 (+100.0)"),
    ]


def test_a_method_is_touched_when_one_of_its_cells_is(swept: list[Swept]) -> None:
    first = swept[0]
    identity = next(identity for identity in first.keys if identity.method == "human")
    swept[0] = Swept(first.text, first.value, first.frame, {**first.keys, identity: "another"})
    assert [(line.group.method, line.text) for line in lines(swept)][:3] == [("human", "0"), ("human", "0.20"), ("human", "0.6")]


def test_a_missing_cell_belongs_to_its_value_alone(tmp_path: Path) -> None:
    swept = invent_sweep(tmp_path, missing=[LOST])
    table = sweep_table(KEY, swept)
    assert [row.labels[1:] for row in table.rows[1:3]] == [("Diffusion [3 of 4 cells]", "0"), ("Diffusion", "0.20")]
    assert any(note.startswith("INCOMPLETE: 1 of 16 cells are missing (1 not computed).") for note in table.notes)
    labels = [row.labels[1:] for row in sweep_operator_table(KEY, swept).rows]
    assert ("Noisy 0.6", "Diffusion [1 of 2 cells]", "0") in labels
    assert ("Noisy 0.2", "Diffusion", "0") in labels
    report = SweepReport("s", "spec", KEY, tuple(swept))
    assert [gap.label for gap in report.missing] == ["goal1 diffusion-full-noisy-0.6-1 [diffusion.ratio=0]"]


def test_what_is_written(swept: list[Swept], tmp_path: Path) -> None:
    report = SweepReport("little-sweep-diffusion.ratio", "little", KEY, tuple(swept))
    folder = tmp_path / "report"
    folder.mkdir()
    (folder / "sweep_race1.png").write_bytes(b"of an earlier sweep")
    files = report.write(folder)
    assert {path.name for path in folder.iterdir()} == {path.name for path in files}
    assert [path.name for path in files] == [
        "report.md", *(f"{name}.{ending}" for name in ("sweep", "sweep_operators") for ending in ("md", "csv", "tex", "html")),
        "sweep_goal1.png", "sweep_goal1.svg",
    ]  # fmt: skip
    header, *rows = csv.reader(io.StringIO((folder / "sweep.csv").read_text(encoding="utf-8")))
    assert header[:4] == ["task", "method", "diffusion.ratio", "return"]
    assert [row[1:4] for row in rows] == [
        ["Human-only", "-", "6.5"],
        *(["Diffusion", text, str(6.5 + n)] for n, (text, _) in enumerate(NUMBERS)),
    ]
    page = files[0].read_text(encoding="utf-8")
    assert "Spec `little`, `diffusion.ratio` = `0`, `0.20`, `0.6`." in page
    assert "16 of 16 different cells, 32 episodes." in page
    assert "![diffusion.ratio](sweep_goal1.png)" in page
    assert "Missing cells" not in page
