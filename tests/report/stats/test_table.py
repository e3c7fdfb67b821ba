"""The table of cells: what is chosen of it, put together again, and paired."""

import numpy as np
import pytest

from tests.report.made import one_cell
from wasp_cli.cells.table import CellTable, paired
from wasp_cli.store.tables import CellIdentity


def cell(seed: int, worlds: list[float], costs: list[float], method: str = "ida") -> CellTable:
    identity = CellIdentity("goal1", method, "full", "noisy", 0.2, seed)
    return one_cell(identity, worlds, cost=costs, viol=costs, decisions=[1.0, 3.0][: len(costs)])


@pytest.fixture
def table() -> CellTable:
    parts = [cell(0, [1, 2], [4, 8]), cell(1, [3], [5]), cell(2, [6, 7], [0, np.nan])]
    return CellTable.joined(parts)


def test_rates_are_ratios_of_sums_and_undefined_episodes_do_not_count(table: CellTable) -> None:
    assert table.pooled("cost").tolist() == [6.0, 5.0, 0.0]
    assert table.pooled("viol").tolist() == [(4 + 3 * 8) / 4, 5.0, 0.0]
    assert np.isnan(table.pooled("mag")).all()  # there is no such column


def test_a_choice_has_its_episodes_in_its_order(table: CellTable) -> None:
    part = table.choose([2, 0])
    assert [one.seed for one in part] == [2, 0]
    assert part.worlds.tolist() == [6, 7, 1, 2]
    assert part.pooled("cost").tolist() == [0.0, 6.0]
    assert part.choose([1]).episodes("cost").tolist() == [4, 8]
    assert table.where(lambda one: one.seed == 1).worlds.tolist() == [3]
    assert len(table.choose([])) == len(table.choose([]).worlds) == 0


def test_a_cell_without_episodes_is_left_out(table: CellTable) -> None:
    kept = table.with_episodes(np.array([False, True, False, True, False]))
    assert [one.seed for one in kept] == [0, 2]
    assert kept.pooled("cost").tolist() == [8.0, 0.0]


def test_tables_come_together_again(table: CellTable) -> None:
    whole = CellTable.joined([table.choose([0]), table.choose([1, 2])])
    assert whole.cells == table.cells
    for name in ("cost", "world"):
        np.testing.assert_array_equal(whole.episodes(name), table.episodes(name))
    assert len(CellTable.joined([])) == 0


def test_pairs_are_under_one_condition_and_in_worlds_that_both_have(table: CellTable) -> None:
    other = [cell(1, [3], [1], "human"), cell(0, [2, 9], [7, 7], "human"), cell(5, [1], [1])]
    own, reference = paired(table, CellTable.joined(other), "cost")
    assert [one.seed for one in own] == [one.seed for one in reference] == [0, 1]
    assert own.worlds.tolist() == reference.worlds.tolist() == [2, 3]
    assert own.pooled("cost").tolist() == [8.0, 5.0]
    assert reference.pooled("cost").tolist() == [7.0, 1.0]
