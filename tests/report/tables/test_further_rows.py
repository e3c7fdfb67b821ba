"""Ablations of WASP stay among ablations and say of how many episodes they changed nothing; the printed WASP is a method of its own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.report.claims.test_verdict import cell, frame_of
from wasp_cli.report.figures import cost_return_figure
from wasp_cli.report.stats import CellNumbers, Wanted, read_frame
from wasp_cli.report.summary import same_episodes
from wasp_cli.report.tables.by_axis import operator_table, severity_table
from wasp_cli.report.tables.comparison import comparison_table
from wasp_cli.report.tables.main import ablation_table, detail_table, latency_table, main_table, threshold_table
from wasp_cli.report.tables.table import Table

TITLE = "WASP, no Case II recovery"


def labels(table: Table | None) -> list[str]:
    return [label for row in table.rows for label in row.labels]


def test_an_ablation_has_no_row_in_the_tables_and_figures_of_the_methods(grid: Callable[..., list[Wanted]], tmp_path: Path) -> None:
    frame = read_frame(grid(ablations=("no-case2",)))
    tables = [
        main_table(frame), detail_table(frame), latency_table(frame), operator_table(frame), severity_table(frame),
        comparison_table(frame),
    ]  # fmt: skip
    for table in tables:
        assert "WASP" in labels(table)
        assert TITLE not in labels(table)
    assert {"WASP, full", TITLE} <= set(labels(ablation_table(frame)))
    assert {"WASP", TITLE} <= set(labels(threshold_table(frame)))
    pictures = [path for path in cost_return_figure(frame, tmp_path) if path.suffix == ".svg"]
    assert len(pictures) == 1
    assert not any(TITLE in path.read_text() for path in pictures)


def wasp(costs: list[float], variant: str = "full", seed: int = 0, **more: Any) -> CellNumbers:
    return cell("wasp", costs, seed, variant=variant, **{"mag": [0.1] * len(costs), **more})


def test_equal_in_all_that_happened_and_in_the_same_world() -> None:
    full = wasp([1.0, 2.0, 3.0])
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2")], [full]) == (3, 3)
    assert same_episodes([wasp([1.0, 2.5, 3.0], "no-case2")], [full]) == (2, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2", mag=[0.1, 0.1, 0.2])], [full]) == (2, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2", mag=[0.1, np.nan, 0.1])], [full]) == (2, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0, 4.0], "no-case2")], [full]) == (3, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2", seed=1)], [full]) == (0, 0)


@pytest.mark.parametrize(("costs", "note"), [([1.0, 2.0, 7.0], "2 of 3 episodes"), ([5.0, 6.0, 7.0], "")])
def test_the_table_says_it_where_there_are_any(costs: list[float], note: str) -> None:
    columns = {name: [0.0] * 3 for name in ("return", "success", "viol", "int_rate")}
    table = ablation_table(frame_of(wasp([1.0, 2.0, 3.0], **columns), wasp(costs, "no-case2", **columns)))
    found = [text for text in table.notes if "the same as with the full method" in text]
    assert [text.partition(" are ")[0] for text in found] == ([f"Goal1, WASP, no Case II recovery: {note}"] if note else [])
