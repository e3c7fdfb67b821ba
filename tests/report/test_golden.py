"""The tables of one small grid, byte for byte. After a wanted change: `WASP_GOLDEN=write pytest tests/report/test_golden.py`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from wasp_cli.report.render import RENDERERS
from wasp_cli.report.stats import Frame, Wanted, read_frame
from wasp_cli.report.tables.by_axis import operator_table, severity_table
from wasp_cli.report.tables.comparison import BEST, HUMAN, comparison_tables
from wasp_cli.report.tables.main import ablation_table, autonomy_table, detail_table, latency_table, main_table, threshold_table
from wasp_cli.report.tables.table import Table

GOLDEN = Path(__file__).parent.parent / "golden"


def comparison_table(frame: Frame) -> Table:
    return comparison_tables(frame, (HUMAN,))[0]


def best_table(frame: Frame) -> Table:
    return comparison_tables(frame, (BEST,))[0]


TABLES: tuple[Callable[[Frame], Table | None], ...] = (
    main_table, ablation_table, operator_table, autonomy_table, detail_table, threshold_table,
    comparison_table, best_table, severity_table, latency_table,
)  # fmt: skip


def golden(name: str, text: str) -> str:
    """What a file should say; with WASP_GOLDEN=write it says `text` from now on."""
    path = GOLDEN / name
    if os.environ.get("WASP_GOLDEN") == "write":
        path.write_text(text, encoding="utf-8")
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize("ending", RENDERERS)
@pytest.mark.parametrize("make", TABLES, ids=lambda make: make.__name__)
def test_tables(frame: Frame, make: Callable[[Frame], Table | None], ending: str) -> None:
    table = make(frame)
    text = RENDERERS[ending](table)
    assert text == golden(f"{table.name}.{ending}", text)


def test_incomplete_grid(grid: Callable[..., list[Wanted]]) -> None:
    wanted = grid(seeds=(0,), ablations=("no-case2",))
    for cell in (wanted[0], *wanted[4:8], wanted[-2]):
        cell.path.unlink()
    frame = read_frame(wanted)
    texts = [RENDERERS["md"](table) for table in (main_table(frame), ablation_table(frame)) if table is not None]
    assert all("INCOMPLETE: 6 of 25 cells are missing" in text for text in texts)
    text = "\n".join(texts)
    assert text == golden("incomplete.md", text)


def test_grid_without_ablations_has_no_such_table(grid: Callable[..., list[Wanted]]) -> None:
    assert ablation_table(read_frame(grid(seeds=(0,)))) is None
