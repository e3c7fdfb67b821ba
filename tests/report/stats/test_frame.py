"""The numbers of cells, and what a row of a table makes of them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from tests.report.branched import TAU_R, WINDOW, with_invented_branches
from tests.report.invented import write_grid
from wasp_cli.report import figures
from wasp_cli.report.figures import necessity_figure
from wasp_cli.report.stats import (
    JUDGED,
    CellNumbers,
    Frame,
    Wanted,
    groups,
    read_frame,
    with_branches,
)
from wasp_cli.report.summary import over_episodes, paired_difference, summarise
from wasp_cli.report.tables import Table
from wasp_cli.report.tables.comparison import necessity_table
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
    assert cell.pooled["viol"] == pytest.approx(
        (np.array(table["viol"]) * steps).sum() / steps.sum()
    )
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
    assert (len(found["human"].cells), found["human"].absent, found["human"].complete) == (
        0,
        4,
        False,
    )
    assert (len(found["ida"].cells), found["ida"].absent) == (3, 1)
    assert found["wasp"].complete


def cell(seed: int, value: float, number: float, costs: Sequence[float] = (0.0,)) -> CellNumbers:
    identity = CellIdentity("goal1", "ida", "full", "noisy", value, seed)
    return CellNumbers(
        identity,
        "mild",
        {"return": number},
        {"cost": np.array(costs, np.float64), "world": np.arange(float(len(costs)))},
    )


def test_mean_and_spread_by_hand() -> None:
    cells = [cell(0, 0.2, 1.0), cell(0, 0.4, 3.0), cell(1, 0.2, 5.0), cell(1, 0.4, 7.0)]
    value = summarise(cells, "return")
    assert (value.mean, value.n) == (4.0, 2)
    # of the seed means 2 and 6, not of the four cells
    assert value.sd == pytest.approx(math.sqrt(8))


def test_paired_difference_uses_what_both_have() -> None:
    reference = [cell(0, 0.2, 1.0), cell(0, 0.4, 10.0), cell(1, 0.2, 2.0)]
    assert (
        paired_difference(
            [cell(0, 0.2, 4.0), cell(1, 0.2, 3.0), cell(2, 0.2, 99.0)], reference, "return"
        )
        == 2.0
    )
    assert paired_difference([cell(5, 0.2, 1.0)], reference, "return") is None
    assert paired_difference([cell(0, 0.2, math.nan)], reference, "return") is None


def test_episodes_are_pooled_over_cells() -> None:
    cells = [cell(0, 0.2, 0, [0, 1, 2]), cell(1, 0.2, 0, [100])]
    assert over_episodes(cells, "cost", np.median).mean == 1.5
    assert over_episodes(cells, "cost", np.max).mean == 100
    assert over_episodes([], "cost", np.max).mean is None


# Counterfactual branches beside the other numbers of a cell.


def frame_of(wanted: list[Wanted]) -> Frame:
    return with_branches(read_frame(wanted), wanted)


def branches_of(wanted: list[Wanted], method: str) -> list[Wanted]:
    return [
        cell.branches
        for cell in wanted
        if cell.identity.method == method and cell.branches is not None
    ]


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
                    delta_c, delta_r = (
                        sum(cf["costs"]) - sum(asst["costs"]),
                        sum(asst["rewards"]) - sum(cf["rewards"]),
                    )
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
                assert cell.episodes[name][e] == pytest.approx(
                    np.mean(numbers) if numbers else np.nan, nan_ok=True
                )
        assert {name: cell.pooled[name] for name in JUDGED} == {
            name: pytest.approx(np.mean(numbers)) for name, numbers in pooled.items()
        }
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
    first, second, third, fourth = (
        i for i, cell in enumerate(wanted) if cell.identity.method == "ida"
    )

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
    small = next(
        cell for cell in grid(seeds=(0,), episodes=4) if cell.identity == large[0].identity
    )
    mixed = [replace(small, branches=wanted[0].branches)]
    assert "it is about 5 episodes, and the cell has 4" in frame_of(mixed).unbranched[0].reason


# Figure 3: as a table and as a picture.


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Frame:
    return frame_of(
        with_invented_branches(
            write_grid(tmp_path_factory.mktemp("grid"), ablations=("safety-only",))
        )
    )


def row(table: Table, method: str) -> dict[str, float | None]:
    values = next(row.values for row in table.rows if row.labels[1].startswith(method))
    return {column.key: value.mean for column, value in zip(table.columns, values, strict=True)}


def test_a_row_is_the_mean_over_seeds_of_its_cells(judged: Frame) -> None:
    found = row(necessity_table(judged), "IDA")
    cells = [cell for cell in judged.cells if cell.identity.method == "ida"]
    by_seed = [
        np.mean([cell.pooled["uir"] for cell in cells if cell.identity.seed == seed])
        for seed in (0, 1, 2)
    ]
    assert found["uir"] == pytest.approx(np.mean(by_seed))
    assert found["interventions"] == sum(cell.episodes["intervened"].sum() for cell in cells)
    assert found["branched"] == found["interventions"]
    assert "Human-only" not in {
        label for row in necessity_table(judged).rows for label in row.labels
    }


def test_a_sample_is_told_and_so_is_a_small_one(grid: Grid) -> None:
    table = necessity_table(frame_of(with_invented_branches(grid(seeds=(0,)), stride=12)))
    found = row(table, "WASP")
    assert found["interventions"] == 4 * 20
    assert found["branched"] == 4 * 2
    assert any(
        note.startswith(
            "Fewer than 30 interventions were branched of IDA, Diffusion, SafeRL-Res, WASP:"
        )
        for note in table.notes
    )


def test_rows_without_all_branches_are_partial_and_never_best(grid: Grid) -> None:
    wanted = with_invented_branches(grid(seeds=(0, 1)))
    table = necessity_table(frame_of(wanted))
    best = {table.rows[r].labels[1] for r, c in table.marks if table.columns[c].key == "uir"}
    assert best == {"WASP"}
    gone = next(cell.branches for cell in wanted if cell.identity.method == "wasp")
    gone.path.unlink()
    partial = necessity_table(frame_of(wanted))
    assert "WASP [7 of 8 cells]" in {row.labels[1] for row in partial.rows}
    assert not any(partial.rows[r].labels[1].startswith("WASP") for r, _ in partial.marks)
    assert any(
        note.startswith("INCOMPLETE: 1 cell has no counterfactual branches")
        for note in partial.notes
    )


def test_without_counterfactuals_there_is_neither_table_nor_figure(
    grid: Grid, tmp_path: Path
) -> None:
    frame = frame_of(grid(seeds=(0,)))
    assert necessity_table(frame) is None
    assert necessity_figure(frame, tmp_path / "none") == []


def test_the_classes_of_risk_have_the_shares_of_the_table(
    grid: Grid, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    wanted, drawn = grid(seeds=(0, 1)), []
    frame = frame_of(
        [*with_invented_branches(wanted[::2]), *with_invented_branches(wanted[1::2], stride=3)]
    )
    monkeypatch.setattr(figures, "figure_files", lambda figure, *_: drawn.append(figure) or [])
    necessity_figure(frame, tmp_path)
    at_risk = [
        100 * (row(necessity_table(frame), method)["at_risk"] or 0.0)
        for method in ("IDA", "Diffusion", "SafeRL-Res", "WASP")
    ]
    free = drawn[0].axes[0].patches[:: len(figures.CLASSES)]  # the first class of each row
    assert [100 - bar.get_width() for bar in free] == pytest.approx(at_risk)


def test_the_figure_says_what_it_is_made_from_and_is_the_same_twice(
    judged: Frame, tmp_path: Path
) -> None:
    one, other = tmp_path / "a", tmp_path / "b"
    one.mkdir()
    other.mkdir()
    files = necessity_figure(judged, one)
    assert [path.name for path in files] == ["figure3.png", "figure3.svg"]
    assert [path.read_bytes() for path in files] == [
        path.read_bytes() for path in necessity_figure(judged, other)
    ]
    drawn = files[1].read_text(encoding="utf-8")
    for text in (
        "IDA",
        "SafeRL-Res",
        "Goal1",
        "n = ",
        "UIR",
        "hollow: branches swapped",
        "share of the next 4 decisions",
        "no cost",
    ):
        assert text in drawn
    with Image.open(files[0]) as picture:
        assert picture.width >= 1200
        assert len(set(picture.convert("L").resize((200, 80)).tobytes())) > 10
