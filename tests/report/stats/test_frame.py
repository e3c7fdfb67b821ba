"""The numbers of cells, and what a row of a table makes of them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from wasp_cli.report.stats import CellNumbers, Wanted, groups, read_frame
from wasp_cli.report.summary import over_episodes, paired_difference, spread_note, summarise
from wasp_cli.store.tables import CellIdentity, read_episodes

Grid = Callable[..., list[Wanted]]


def test_a_cell_is_pooled_before_anything_else(grid: Grid) -> None:
    wanted = grid(seeds=(0,))
    frame = read_frame(wanted)
    assert not frame.missing
    assert [cell.identity for cell in frame.cells] == [cell.identity for cell in wanted]
    table = read_episodes([wanted[17].path])
    steps = np.array(table["decisions"])
    cell = frame.cells[17]
    assert cell.count == 4
    assert cell.pooled["viol"] == pytest.approx((np.array(table["viol"]) * steps).sum() / steps.sum())
    assert cell.pooled["return"] == pytest.approx(np.mean(table["return"]))
    assert cell.pooled["decision_p50_ms"] == 2.0
    assert cell.episodes["cost"].tolist() == table["cost"].to_pylist()
    assert cell.thresholds.tau_c == 0.3


def test_a_method_that_never_acts_has_no_mag_given_int(grid: Grid) -> None:
    frame = read_frame(grid(seeds=(0,)))
    human = [cell for cell in frame.cells if cell.identity.method == "human"]
    assert all(np.isnan(cell.pooled["mag_int"]) and cell.pooled["mag"] == 0.0 for cell in human)


def test_missing_cells_are_named(grid: Grid) -> None:
    wanted = grid(seeds=(0,))
    wanted[0].path.unlink()
    wanted[1].path.write_bytes(wanted[1].path.read_bytes()[:200])
    wanted[2].path.unlink()
    wanted[2] = replace(wanted[2], failure="TrainingError: no data")
    wanted[4].path.write_bytes(wanted[3].path.read_bytes())  # a file at the wrong place
    frame = read_frame(wanted)
    reasons = {cell.label: cell.reason for cell in frame.missing}
    assert len(frame.cells) == len(wanted) - 4
    assert reasons[wanted[0].label] == "not computed yet"
    assert "damaged" in reasons[wanted[1].label]
    assert "(run the spec again: what is damaged is computed again)" in reasons[wanted[1].label]
    assert reasons[wanted[2].label] == "failed: TrainingError: no data"
    assert "holds another cell" in reasons[wanted[4].label]


def test_groups_keep_order_and_count_what_is_absent(grid: Grid) -> None:
    wanted = grid(seeds=(0,))
    for cell in wanted[:4]:  # all of human
        cell.path.unlink()
    wanted[4].path.unlink()  # one of IDA
    found = {group.method: group for group in groups(read_frame(wanted))}
    assert list(found) == ["human", "ida", "diffusion", "saferl", "wasp", "expert"]
    assert (len(found["human"].cells), found["human"].absent, found["human"].complete) == (0, 4, False)
    assert (len(found["ida"].cells), found["ida"].absent) == (3, 1)
    assert found["wasp"].complete


def cell(seed: int, value: float, number: float, costs: Sequence[float] = (0.0,)) -> CellNumbers:
    identity = CellIdentity("goal1", "ida", "full", "noisy", value, seed)
    return CellNumbers(identity, "mild", {"return": number}, {"cost": np.array(costs, np.float64)})


def test_mean_and_spread_by_hand() -> None:
    cells = [cell(0, 0.2, 1.0), cell(0, 0.4, 3.0), cell(1, 0.2, 5.0), cell(1, 0.4, 7.0)]
    value = summarise(cells, "return")
    assert (value.mean, value.n) == (4.0, 2)
    assert value.sd == pytest.approx(math.sqrt(8))  # of the seed means 2 and 6, not of the four cells


def test_paired_difference_uses_what_both_have() -> None:
    reference = [cell(0, 0.2, 1.0), cell(0, 0.4, 10.0), cell(1, 0.2, 2.0)]
    assert paired_difference([cell(0, 0.2, 4.0), cell(1, 0.2, 3.0), cell(2, 0.2, 99.0)], reference, "return") == 2.0
    assert paired_difference([cell(5, 0.2, 1.0)], reference, "return") is None
    assert paired_difference([cell(0, 0.2, math.nan)], reference, "return") is None


def test_episodes_are_pooled_over_cells() -> None:
    cells = [cell(0, 0.2, 0, [0, 1, 2]), cell(1, 0.2, 0, [100])]
    assert over_episodes(cells, "cost", np.median).mean == 1.5
    assert over_episodes(cells, "cost", np.max).mean == 100
    assert over_episodes([], "cost", np.max).mean is None


def test_the_note_states_the_unit(grid: Callable[..., list[Wanted]]) -> None:
    three = spread_note(read_frame(grid()).cells)
    assert "means of 3 seeds, not over episodes" in three
    assert "10 distinct bootstrap resamples" in three
    assert "no ±" in spread_note([cell(4, 0.2, 1.0)])
    assert "No cell" in spread_note([])
