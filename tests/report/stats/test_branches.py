"""Counterfactual branches beside the other numbers of a cell."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.report.branched import TAU_R, WINDOW, with_invented_branches
from wasp_cli.report.stats import JUDGED, CellNumbers, Frame, Wanted, read_frame, with_branches

Grid = Callable[..., list[Wanted]]


def frame_of(wanted: list[Wanted]) -> Frame:
    return with_branches(read_frame(wanted), wanted)


def branches_of(wanted: list[Wanted], method: str) -> list[Wanted]:
    return [cell.branches for cell in wanted if cell.identity.method == method and cell.branches is not None]


def of_method(frame: Frame, method: str) -> list[CellNumbers]:
    return [cell for cell in frame.cells if cell.identity.method == method]


def test_columns_are_means_over_the_branched_interventions_of_an_episode(grid: Grid) -> None:
    wanted = with_invented_branches(grid(seeds=(0,)), stride=2)
    frame = frame_of(wanted)
    assert frame.unbranched == ()
    for cell, source in zip(of_method(frame, "ida"), branches_of(wanted, "ida"), strict=True):
        rows = pq.read_table(source.path).to_pylist()
        pairs = list(zip(rows[::2], rows[1::2], strict=True))
        pooled: dict[str, list[float]] = {name: [] for name in JUDGED}
        for e in range(cell.count):
            own: dict[str, list[float]] = {name: [] for name in JUDGED}
            for asst, cf in pairs:
                if cf["episode"] == e:
                    delta_c, delta_r = sum(cf["costs"]) - sum(asst["costs"]), sum(asst["rewards"]) - sum(cf["rewards"])
                    own["rho"].append(sum(cf["costs"]) / WINDOW)
                    own["at_risk"].append(any(cf["costs"]))
                    own["delta_c"].append(delta_c)
                    own["delta_r"].append(delta_r)
                    own["uir"].append(delta_c <= 0 and delta_r <= TAU_R)
                    own["uir_swapped"].append(-delta_c <= 0 and -delta_r <= TAU_R)
                    if (asst["costs"], asst["rewards"]) != (cf["costs"], cf["rewards"]):
                        own["uir_eff"].append(own["uir"][-1])
            assert cell.episodes["branches"][e] == len(own["uir"])
            assert cell.episodes["effective_branches"][e] == len(own["uir_eff"])
            for name, numbers in own.items():
                pooled[name] += numbers
                assert cell.episodes[name][e] == pytest.approx(np.mean(numbers) if numbers else np.nan, nan_ok=True)
        assert {name: cell.pooled[name] for name in JUDGED} == {name: pytest.approx(np.mean(numbers)) for name, numbers in pooled.items()}
        for name in ("uir", "uir_swapped", "uir_eff"):
            total, mass = cell.weighted(name)
            assert total.sum() / mass.sum() == pytest.approx(cell.pooled[name])


def test_a_cell_without_interventions_defines_nothing(grid: Grid) -> None:
    wanted = grid(seeds=(0,))
    ida = next(i for i, cell in enumerate(wanted) if cell.identity.method == "ida")
    some = with_invented_branches([wanted[ida]], stride=10**6)  # the first intervention alone
    frame = frame_of(some)
    (cell,) = frame.cells
    assert cell.episodes["branches"].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert np.isnan(cell.episodes["uir"][1:]).all()
    assert cell.pooled["uir"] == cell.episodes["uir"][0]


def test_branches_that_are_not_there_are_named_and_the_cell_stays(grid: Grid) -> None:
    wanted = with_invented_branches(grid(seeds=(0,)))
    first, second, third, fourth = (i for i, cell in enumerate(wanted) if cell.identity.method == "ida")

    def change(index: int, **values: object) -> Wanted:
        branches = wanted[index].branches
        assert branches is not None
        wanted[index] = replace(wanted[index], branches=replace(branches, **values))  # type: ignore[arg-type]
        return branches

    change(first).path.unlink()
    change(second, failure="TrainingError: no tau_R").path.unlink()
    damaged = change(third)
    damaged.path.write_bytes(damaged.path.read_bytes()[:100])
    other = branches_of(wanted, "wasp")[0]
    change(fourth).path.write_bytes(other.path.read_bytes())
    frame = frame_of(wanted)
    assert not frame.missing
    assert len(of_method(frame, "ida")) == 4
    reasons = [gap.reason for gap in frame.unbranched]
    assert reasons[:2] == ["not computed yet", "failed: TrainingError: no tau_R"]
    assert "is damaged" in reasons[2]
    assert "the branches of another cell" in reasons[3]
    assert [gap.damaged for gap in frame.unbranched] == [False, False, True, True]
    assert {gap.kind for gap in frame.unbranched} == {"counterfactual"}
    assert all(gap.label.endswith("counterfactual branches") for gap in frame.unbranched)
    assert len(frame.judged) == 3 * 4


def test_branches_of_more_episodes_than_the_cell_has_are_refused(grid: Grid) -> None:
    large = [cell for cell in grid(seeds=(0,), episodes=5) if cell.identity.method == "ida"][:1]
    wanted = with_invented_branches(large)
    small = next(cell for cell in grid(seeds=(0,), episodes=4) if cell.identity == large[0].identity)
    mixed = [replace(small, branches=wanted[0].branches)]
    assert "it is about 5 episodes, and the cell has 4" in frame_of(mixed).unbranched[0].reason
