"""The page LEADERBOARD.md: its numbers are those of the published rows and the submissions."""

import re
from dataclasses import replace
from pathlib import Path

import pyarrow.compute as pc
import pytest

from tests.commands import ROOT
from wasp_cli.leaderboard.board import CLASSES, Board, board_of, class_of
from wasp_cli.leaderboard.lines import (
    Line,
    Numbered,
    Shipped,
    ahead,
    shipped_lines,
    submitted_lines,
)
from wasp_cli.leaderboard.page import escaped, page_of
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.bootstrap import Estimate
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import cell_file, read_episodes

PAGE = ROOT / "LEADERBOARD.md"
SUBMISSIONS = sorted(path.parent for path in (ROOT / "leaderboard").glob("*/submission.json"))


@pytest.fixture(scope="module")
def board() -> Board:
    return board_of()


@pytest.fixture(scope="module")
def shipped(board) -> Shipped:
    return shipped_lines(board)


def tables_of(text: str) -> dict[str, list[list[str]]]:
    """The rows of the tables of a page, by the heading above each."""
    parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)[1:]
    tables = {}
    for heading, part in zip(parts[::2], parts[1::2], strict=True):
        lines = [line for line in part.splitlines() if line.startswith("| ")]
        tables[heading] = [line[2:-2].split(" | ") for line in lines]
    return tables


def test_the_page_has_the_numbers_of_the_published_rows_and_of_every_submission(board, shipped):
    page = page_of(shipped, submitted_lines(SUBMISSIONS, board), board, ROOT)
    written = tables_of(PAGE.read_text(encoding="utf-8"))
    assert written == tables_of(page)
    assert len(written) == len(board.spec.tasks)
    # the heading, its rule, the shipped assistants that are whole, and submissions
    rows = 2 + len(board.spec.methods) - len(shipped.partial) + len(SUBMISSIONS)
    assert all(len(table) == rows for table in written.values())


def test_a_line_is_the_mean_over_its_cells(board, shipped):
    layout = Layout(board.published)
    grid = lay_out_over(board.spec, Layout(Path("nowhere")), str(board.published))
    paths = [
        cell_file(layout.artifact(node.kind, node.key))
        for cell, node in grid.cells
        if (cell.task, cell.method) == ("race1", "wasp")
    ]
    cells = [read_episodes([path]) for path in paths]
    (line,) = [line for line in shipped.lines if (line.task, line.title) == ("race1", "WASP")]

    def mean(numbers: list[float]) -> float:
        return sum(numbers) / len(numbers)

    assert len(cells) == 12
    returned = mean([pc.mean(cell["return"]).as_py() for cell in cells])
    rate = mean(
        [pc.sum(cell["cost"]).as_py() / pc.sum(cell["env_steps"]).as_py() for cell in cells]
    )
    acted = [pc.multiply(cell["int_eff"], cell["decisions"]) for cell in cells]
    effective = mean(
        [
            pc.sum(each).as_py() / pc.sum(cell["decisions"]).as_py()
            for each, cell in zip(acted, cells, strict=True)
        ]
    )
    assert line.numbers.returned.value == pytest.approx(returned)
    assert line.numbers.cost_rate.value == pytest.approx(rate)
    assert line.numbers.effective is not None
    assert line.numbers.effective.value == pytest.approx(effective)
    assert line.bound == 0.2


def test_a_class_holds_what_its_bound_does_not_exceed():
    assert [class_of(bound) for bound in CLASSES] == list(CLASSES)
    assert class_of(0.0) == CLASSES[0]
    assert class_of(CLASSES[0] + 1e-9) == CLASSES[1]


def line_of(returned: float, cost: float, effective: float, **changes: object) -> Line:
    one = Estimate(returned, None)
    numbers = Numbered(
        one, Estimate(cost, None), Estimate(cost, None), Estimate(effective, None), one
    )
    line = Line("goal1", "It", "me", "2026-12-01", "0.3.0", None, reference=False, numbers=numbers)
    return replace(line, **changes)  # type: ignore[arg-type]


def test_ahead_is_who_nobody_of_the_class_or_a_milder_one_betters():
    mild, costly, acting = line_of(10, 5, 0.05), line_of(12, 9, 0.08), line_of(10, 6, 0.3)
    lines = [
        mild,
        costly,
        acting,
        line_of(20, 0, 0.01, reference=True),
        line_of(9, 9, 0, task="race1"),
    ]
    assert [ahead(line, lines) for line in lines] == [True, True, False, False, True]
    assert ahead(mild, [mild, line_of(10, 5, 0.05)])


def test_words_of_others_stay_in_their_cell():
    assert escaped("a | b\n[c](d) `e`") == "a \\| b \\[c\\](d) \\`e\\`"
