import csv
import io
from dataclasses import replace

import pytest
from rich.console import Console

from wasp_cli.report.render import csv_text, markdown, terminal
from wasp_cli.report.summary import Interval, Value
from wasp_cli.report.tables.table import Column, Row, Table

RETURN = Column("return", "Return", "up")
COST = Column("cost", "Cost", "down", digits=1)

NARROW = Interval(-0.1, 0.6, "training", 3)


def table(*rows: Row, columns: tuple[Column, ...] = (RETURN, COST), notes: tuple[str, ...] = ()) -> Table:
    return Table("t", "A title", ("Task", "Method"), columns, rows, notes)


def row(task: str, method: str, *numbers: float | Value | None) -> Row:
    return Row((task, method), tuple(number if isinstance(number, Value) else Value(number) for number in numbers))


def test_best_is_per_group_and_direction() -> None:
    found = table(row("a", "x", 1, 5), row("a", "y", 2, 4), row("b", "x", 9, 9), row("b", "y", 8, 10))
    assert found.marks == {(1, 0), (1, 1), (2, 0), (2, 1)}


def test_two_labels_can_form_a_group() -> None:
    rows = (row("a", "x", 1, 5), row("a", "x", 2, 4), row("a", "y", 8, 9), row("a", "y", 9, 9))
    found = Table("t", "A title", ("Task", "Operator"), (RETURN, COST), rows, grouping=2)
    assert found.marks == {(1, 0), (1, 1), (3, 0)}
    assert [line.split(" | ")[:2] for line in markdown(found).splitlines()[4:]] == [["| a", "x"], ["| ", ""], ["| a", "y"], ["| ", ""]]


def test_equal_as_printed_share_the_mark() -> None:
    found = table(row("a", "x", 1.001, 5), row("a", "y", 1.004, 5), row("a", "z", 0.5, 5))
    assert found.marks == {(0, 0), (1, 0)}  # and nobody is best where all print the same


def test_unranked_and_undefined_are_never_best() -> None:
    found = table(row("a", "x", Value(99, ranked=False), Value(None)), row("a", "y", 2, float("nan")), row("a", "z", 1, 3))
    assert found.marks == {(1, 0)}


def test_second_best_needs_somebody_behind() -> None:
    three = table(row("a", "x", 1, 5), row("a", "y", 2, 5), row("a", "z", 3, 6), row("a", "u", 2.001, Value(4, ranked=False)))
    assert three.marks == {(2, 0), (0, 1), (1, 1)}
    assert three.seconds == {(1, 0), (3, 0)}  # as printed they share the place; the last of two costs is no second
    assert replace(three, ranked=False).seconds == frozenset()


def test_numbers() -> None:
    percent = Column("s", "S", scale=100.0, digits=1)
    assert percent.cell(Value(0.5, 0.25, 3, delta=-0.1)) == "50.0 ± 25.0 (-10.0)"
    assert percent.cell(Value(0.5, 0.25), spread=False) == "50.0"
    assert Column("s", "S", spread=False).cell(Value(1.0, 0.5, interval=NARROW)) == "1.00"
    assert percent.cell(Value(0.5, 0.25, interval=NARROW)) == "50.0 ± 25.0 [-10.0, 60.0]"
    assert Column("s", "S", signed=True).cell(Value(0.5, interval=NARROW)) == "+0.50 [-0.10, +0.60]"
    assert COST.cell(Value(-0.01)) == "0.0"  # no negative zero
    assert COST.cell(Value(None)) == COST.cell(Value(float("nan"))) == "n/a"
    assert COST.cell(Value(1.0, delta=0.0)) == "1.0 (+0.0)"


def test_rows_must_fit() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        table(row("a", "x", 1))


def test_markdown_escapes_and_names_a_group_once() -> None:
    bar = Column("m", "Mag.|int", "down")
    text = markdown(table(row("a", "x", 1, 2), row("a", "y", 1, 3), columns=(bar, COST), notes=("a note",)))
    assert text.splitlines() == [
        "## A title",
        "",
        "| Task | Method | Mag.\\|int ↓ | Cost ↓ |",
        "| --- | --- | ---: | ---: |",
        "| a | x | 1.00 | **2.0** |",
        "|  | y | 1.00 | 3.0 |",
        "",
        "- a note",
    ]


def test_csv_reads_back() -> None:
    text = csv_text(table(row("a", "x", Value(1 / 3, 0.1, 3), 2), row("a", "y, z", Value(None), 1)))
    header, first, second = csv.reader(io.StringIO(text))
    assert header == ["task", "method", "return", "return_sd", "cost", "seeds"]
    assert first == ["a", "x", "0.333333333333", "0.1", "2", "3"]
    assert second == ["a", "y, z", "", "", "1", "0"]


def test_terminal_styles() -> None:
    console = Console(width=80, file=io.StringIO(), force_terminal=True, color_system="standard", _environ={"TERM": "xterm"})
    console.print(terminal(table(row("a", "x", 1, 5), row("a", "y", 2, 5), row("a", "z", 3, 5)), 80))
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert "\x1b[1;32m3.00" in shown
    assert "\x1b[4m2.00" in shown
    assert "m1.00" not in shown.replace("\x1b[0m", "")


@pytest.mark.parametrize(
    ("width", "spread", "delta", "optional"),
    [(120, True, True, True), (60, False, True, True), (44, False, True, False), (30, False, False, False)],
)
def test_terminal_leaves_out_what_does_not_fit(width: int, spread: bool, delta: bool, optional: bool) -> None:
    console = Console(width=width, file=io.StringIO(), record=True)
    wide = Value(12.25, 3.5, 3, delta=1.5)
    columns = (RETURN, COST, Column("extra", "Extra", optional=True))
    console.print(terminal(table(row("a", "x", wide, wide, wide), row("[red]b", "y", wide, wide, wide), columns=columns), width))
    text = console.export_text()
    assert ("±" in text, "+1.5" in text, "Extra" in text) == (spread, delta, optional)
    assert text.count("12.25") == (4 if optional else 2)
    assert ("hidden;" in text) == (width < 100)
    assert "[red]b" in text  # a label is no markup


def test_a_narrow_terminal_wraps_labels_and_cuts_no_digit() -> None:
    console = Console(width=50, file=io.StringIO(), record=True)
    label = "a measure whose name alone would fill the whole line"
    console.print(terminal(table(row("a", label, -1234.5, 0.25)), 50))
    text = console.export_text()
    assert "-1234.50" in text
    assert "0.2" in text
    assert "…" not in text
    assert "hidden" not in text  # nothing is
