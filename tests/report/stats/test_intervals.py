"""Intervals that are kept are those that the rows give."""

from pathlib import Path

import numpy as np
import pytest

from tests.report.made import renamed
from tests.report.stats.test_bootstrap import cell
from wasp_cli.cells.table import CellTable
from wasp_cli.report import bootstrap
from wasp_cli.report.bootstrap import (
    Contrast,
    Estimate,
    contrast_of,
    difference_of,
    improvement_over,
    iqm_of,
    mean_of,
)
from wasp_cli.report.intervals import intervals_kept
from wasp_cli.store.layout import Layout


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def cells(method: str, cost: float = 3.0, seeds: int = 3) -> CellTable:
    draws = np.random.default_rng(0)
    return CellTable.joined(
        [
            cell(seed, value, method, (1, 2), cost=[draws.random(), cost])
            for seed in range(seeds)
            for value in (0.2, 0.6)
        ]
    )


def found(own: CellTable, other: CellTable) -> list[Estimate | Contrast | None]:
    """Every statistic of two rows."""
    return [
        mean_of(own, "cost"),
        mean_of(own, "return"),
        iqm_of(own, "cost"),
        difference_of(own, other, "cost"),
        improvement_over(own, other, "cost", "down"),
        improvement_over(own, other, "cost", "up"),
        contrast_of(own, other, "cost"),
        contrast_of(own, other, "cost", 0.1),
        contrast_of(own, 2.0, "cost"),
        contrast_of(own.choose([0]), 2.0, "cost"),
        contrast_of(own, other.choose([]), "cost"),
    ]


def test_they_are_those_of_the_rows_the_first_time_and_every_time_after(layout):
    own, other = cells("wasp"), cells("human", 5.0)
    expected = found(own, other)
    for _ in range(2):
        with intervals_kept(layout, "table1"):
            assert found(cells("wasp"), cells("human", 5.0)) == expected


def test_nothing_is_resampled_that_was_before(layout, monkeypatch):
    with intervals_kept(layout, "table1"):
        expected = found(cells("wasp"), cells("human", 5.0))

    def resampled(*_: object) -> None:
        pytest.fail("it was computed again")

    monkeypatch.setattr(bootstrap, "limits_of", resampled)
    with intervals_kept(layout, "table1"):
        assert found(cells("wasp"), cells("human", 5.0)) == expected


@pytest.mark.parametrize("cost", [3.0, 4.0])
def test_other_rows_have_their_own(layout, cost):
    with intervals_kept(layout, "table1"):
        found(cells("wasp"), cells("human", 5.0))
    first = cells("wasp").cells[0]
    own = renamed(cells("wasp", cost), lambda one: {"seed": 7 if one == first else one.seed})
    expected = found(own, cells("human", 5.0))
    with intervals_kept(layout, "table1"):
        assert found(own, cells("human", 5.0)) == expected


def test_a_report_of_another_folder_has_its_own(layout, cache):
    for folder in (layout.root, layout.root / "other"):
        with intervals_kept(Layout(folder), "table1"):
            mean_of(cells("wasp"), "cost")
    assert len(list(cache.rglob("intervals-*"))) == 2


def test_a_damaged_file_is_as_if_nothing_had_been_kept(layout, cache):
    own, other = cells("wasp"), cells("human", 5.0)
    expected = found(own, other)
    with intervals_kept(layout, "table1"):
        found(own, other)
    (path,) = cache.rglob("intervals-*")
    path.write_bytes(path.read_bytes().replace(b"3.0", b"4.0"))
    with intervals_kept(layout, "table1"):
        assert found(own, other) == expected
