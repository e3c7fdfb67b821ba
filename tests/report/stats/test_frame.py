from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from wasp_cli.report.stats.frame import Frame, Wanted, groups, read_frame
from wasp_cli.store.tables import read_episodes

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


def test_an_empty_report_reads(grid: Grid) -> None:
    assert read_frame([]) == Frame(())
