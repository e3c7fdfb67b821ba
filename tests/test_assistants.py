"""docs/assistants.md says what is published: the comparison on fresh seeds, and the curves of every assistant's knob."""

from __future__ import annotations

from pathlib import Path

import assistants
import curves
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "assistants.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("group", assistants.GROUPS)
def test_the_tables_of_results_are_the_published_rows(group: str) -> None:
    rows = pq.read_table(assistants.published("assistants"))
    assert assistants.table(rows, group) in PAGE
    assert assistants.differences(rows, group) in PAGE or group == "The unimpaired expert"


def test_the_operating_points_are_those_of_the_published_curves() -> None:
    assert curves.shown(pq.read_table(curves.published("assistants"))) in PAGE


def test_numbers_of_a_table_are_means_over_operators_of_what_is_pooled_over_worlds() -> None:
    numbers = {"return": 1.0, "success": 1.0, "cost": 4.0, "deviation": 2.0, "branched": 4, "unnecessary": 1, "swapped": 2}
    cells = [("noisy", 0, 10, 5), ("noisy", 1, 30, 3), ("laggy", 0, 10, 0), ("laggy", 1, 10, 2)]
    rows = pa.Table.from_pylist(
        [
            {"task": "goal1", "method": "ida", "operator": operator, "seed": 310, "episode": episode, "decisions": decisions}
            | {"intervened": intervened, "effective": intervened, **numbers}
            for operator, episode, decisions, intervened in cells
        ]
    )
    sums = assistants.cube(assistants.sums_of(rows), "goal1", "ida", ("noisy", "laggy"))
    assert sums.shape == (2, 2, 3 + len(assistants.SUMS))
    found = assistants.measures(sums)
    assert found["intervened"] == pytest.approx((8 / 40 + 2 / 20) / 2)
    assert found["deviation"] == pytest.approx((4 / 40 + 4 / 20) / 2)
    assert (found["uir"], found["mirror"], found["success"]) == pytest.approx((0.25, 0.5, 100.0))
    assert [name for name, value in found.items() if np.isnan(value)] == ["ms"]  # the published rows have no times
    timed = rows.append_column("ms", pa.array([4.0, 6.0, 1.0, 3.0]))
    times = assistants.measures(assistants.cube(assistants.sums_of(timed), "goal1", "ida", ("noisy", "laggy")))
    assert times["ms"] == pytest.approx(3.5)
    assert "| ms |" in assistants.table(timed, "Operators on which choices were made")
