"""A flipped bit in the footer of a cell: every reader of tables names the file and goes on with
the rest, and a run heals it.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.commands import run_here
from tests.compare.two_runs import write_results
from tests.run.harness import ROOT
from tests.view.conftest import viewed
from tests.view.test_cells import numbers
from wasp_cli.cells.asked import Asked
from wasp_cli.cells.read import read_cells, rows_of
from wasp_cli.cells.table import COLUMNS, CellTable
from wasp_cli.compare import compare
from wasp_cli.store.tables import EPISODES_FILE

SPEC = """
name: shipped
extends: {table}
tasks: [goal1]
methods: [human]
variants: [full]
operators: {{noisy: {{moderate: 0.45}}}}
seeds: [1]
"""


def footer(data: bytes) -> range:
    """The places of a Parquet file's footer, without its length and the mark at the end."""
    return range(len(data) - 8 - int.from_bytes(data[-8:-4], "little"), len(data) - 8)


def flip(path: Path, place: int, bit: int = 0) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1 << bit
    path.write_bytes(data)


def letter(path: Path, column: str) -> int:
    """The place of a letter of a column's name where the footer has it as the name of a column
    of the schema.
    """
    data = path.read_bytes()
    name = bytes([len(column)]) + column.encode()
    return data.index(name, footer(data).start) + 1


def one_cell(side: Asked) -> Path:
    return rows_of(side.layout, side.cells[0])


def same(one: CellTable, other: CellTable, name: str) -> bool:
    return np.array_equal(one.episodes(name), other.episodes(name), equal_nan=True)


@pytest.mark.parametrize("stride", [97, pytest.param(1, marks=pytest.mark.slow)])
def test_no_bit_of_a_footer_ends_a_reader(stride, tmp_path):
    """Bytes in turn, another bit of each: the cell is as it was, or it is named; the others are
    read.
    """
    before, after = write_results(tmp_path / "before"), write_results(tmp_path / "after")
    path = one_cell(after)
    whole = path.read_bytes()
    right = read_cells(after.layout, after.cells[:2]).table
    columns = [name for name in right.names if name != "episode"]
    wrong = 0
    # Where the type of a column is: asked for its statistics, pyarrow would end the process.
    types = [
        place + 1
        for place in footer(whole)
        if whole[place : place + 4] in (b"\x15\x0c\x19%", b"\x15\n\x19%")
    ]
    assert types
    for place in {*footer(whole)[::stride], *types}:
        flip(path, place, place % 8)
        found = read_cells(after.layout, after.cells[:2])
        last = found.table.choose([len(found.table) - 1])
        assert all(same(last, right.choose([1]), name) for name in columns)
        if found.missing:
            (gap,) = found.missing
            assert gap.damaged
            assert str(path) in gap.reason
            wrong += place not in types
        else:
            assert all(same(found.table, right, name) for name in columns)
        path.write_bytes(whole)
    assert wrong > len(footer(whole)) / stride / 10, "most of a footer is read"
    flip(path, letter(path, "cost"))
    compared = compare(before, after)
    (cell,) = compared.having("not compared")
    assert str(path) in cell.reason
    assert len(compared.having("same")) == len(compared.cells) - 1


@pytest.mark.parametrize(
    "column",
    [
        "cost",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("episode_seed", "decisions")),
    ],
)
def test_report_compare_and_view_name_the_file_and_go_on(column, without_figures, tmp_path):
    before, after = write_results(tmp_path / "before"), write_results(tmp_path / "after")
    path = one_cell(after)
    assert column in COLUMNS
    flip(path, letter(path, column))
    told = run_here(
        "report",
        after.layout.root,
        "--no-trained",
        "--paper",
        "none",
        columns=400,
        code=1,
    )
    assert f"{path} is damaged: it has no column {column}" in told.output
    assert "1 of 8 cells are missing (1 damaged)" in told.output
    compared = run_here("compare", before.layout.root, after.layout.root, columns=400, code=0)
    assert str(path) in compared.output
    assert "7 the same" in compared.output
    with viewed(after.layout.root) as server:
        found = numbers(server)
        assert [
            EPISODES_FILE in texts[-1] or texts[-1] == "damaged" for texts in found.values()
        ].count(True) == 1
        assert [texts[0] for texts in found.values()].count("8") == 7


@pytest.mark.slow
def test_a_run_heals_it(tmp_path):
    spec, results = tmp_path / "shipped.yaml", tmp_path / "results"
    spec.write_text(SPEC.format(table=ROOT / "specs/table1.yaml"), encoding="utf-8")
    command = ("run", spec, "--results", results, "-j", "0")
    assert run_here(*command, columns=200).exit_code == 0
    path, *_ = sorted(results.glob(f"store/evaluate/*/{EPISODES_FILE}"))
    whole = path.read_bytes()
    flip(path, letter(path, "cost"))
    assert str(path) in run_here(*command, columns=400, code=1).output
    run_here(*command, columns=400, code=0)
    assert path.read_bytes() == whole
