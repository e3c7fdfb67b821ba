"""The numbers of cells, and what a row of a table makes of them."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from tests.report.branched import TAU_R, WINDOW, with_invented_branches
from tests.report.invented import Grid, write_grid
from tests.report.made import one_cell, singles
from wasp_cli.cells.cell import BRANCHES
from wasp_cli.cells.table import JUDGED, CellTable
from wasp_cli.report import figures
from wasp_cli.report.figures import necessity_figure
from wasp_cli.report.stats import Frame
from wasp_cli.report.summary import over_episodes, paired_difference, summarise
from wasp_cli.report.tables import Table
from wasp_cli.report.tables.comparison import necessity_table
from wasp_cli.store.branches import BRANCHES_FILE
from wasp_cli.store.tables import CellIdentity, read_episodes

Grids = Callable[..., Grid]


def test_a_cell_is_pooled_before_anything_else(grid: Grids) -> None:
    made = grid(seeds=(0,))
    frame = made.read()
    assert not frame.missing
    assert list(frame.cells) == made.cells
    table = read_episodes([made.rows(17)])
    steps = np.array(table["decisions"])
    cell = frame.cells.choose([17])
    assert cell.counts.tolist() == [4]
    assert cell.pooled("viol") == pytest.approx(
        (np.array(table["viol"]) * steps).sum() / steps.sum()
    )
    assert cell.pooled("return") == pytest.approx(np.mean(table["return"]))
    assert cell.pooled("decision_p50_ms") == 2.0
    assert cell.episodes("cost").tolist() == table["cost"].to_pylist()
    assert cell.thresholds[0].tau_c == 0.3


def test_a_method_that_never_acts_has_no_mag_given_int(grid: Grids) -> None:
    human = of_method(grid(seeds=(0,)).read(), "human")
    assert np.isnan(human.pooled("mag_int")).all()
    assert (human.pooled("mag") == 0.0).all()


def test_missing_cells_are_named(grid: Grids) -> None:
    made = grid(seeds=(0,))
    made.rows(0).unlink()
    made.rows(1).write_bytes(made.rows(1).read_bytes()[:200])
    made.rows(2).unlink()
    made.rows(4).write_bytes(made.rows(3).read_bytes())  # a file at the wrong place
    frame = made.read({made.cells[2].key: "failed: TrainingError: no data"})
    reasons = {gap.cell: gap.reason for gap in frame.missing}
    assert len(frame.cells) == len(made.cells) - 4
    assert reasons[made.cells[0]] == "not computed yet"
    assert "damaged" in reasons[made.cells[1]]
    assert "(run the spec again: what is damaged is computed again)" in reasons[made.cells[1]]
    assert reasons[made.cells[2]] == "failed: TrainingError: no data"
    assert "holds another cell" in reasons[made.cells[4]]


def test_groups_keep_order_and_count_what_is_absent(grid: Grids) -> None:
    made = grid(seeds=(0,))
    for place in range(5):  # all of human, and one of IDA
        made.rows(place).unlink()
    found = {group.method: group for group in made.read().groups}
    assert list(found) == ["human", "ida", "diffusion", "saferl", "wasp", "expert"]
    human = found["human"]
    assert (len(human.cells), human.absent, human.complete) == (0, 4, False)
    assert (len(found["ida"].cells), found["ida"].absent) == (3, 1)
    assert found["wasp"].complete


def cell(seed: int, value: float, number: float, costs: Sequence[float] = (0.0,)) -> CellTable:
    identity = CellIdentity("goal1", "ida", "full", "noisy", value, seed)
    columns = {"return": np.full(len(costs), number), "cost": costs}
    return one_cell(identity, range(len(costs)), **columns)


def test_mean_and_spread_by_hand() -> None:
    cells = [cell(0, 0.2, 1.0), cell(0, 0.4, 3.0), cell(1, 0.2, 5.0), cell(1, 0.4, 7.0)]
    value = summarise(CellTable.joined(cells), "return")
    assert (value.mean, value.n) == (4.0, 2)
    # of the seed means 2 and 6, not of the four cells
    assert value.sd == pytest.approx(math.sqrt(8))


def test_paired_difference_uses_what_both_have() -> None:
    reference = CellTable.joined([cell(0, 0.2, 1.0), cell(0, 0.4, 10.0), cell(1, 0.2, 2.0)])
    own = CellTable.joined([cell(0, 0.2, 4.0), cell(1, 0.2, 3.0), cell(2, 0.2, 99.0)])
    assert paired_difference(own, reference, "return") == 2.0
    assert paired_difference(cell(5, 0.2, 1.0), reference, "return") is None
    assert paired_difference(cell(0, 0.2, math.nan), reference, "return") is None


def test_episodes_are_pooled_over_cells() -> None:
    cells = CellTable.joined([cell(0, 0.2, 0, [0, 1, 2]), cell(1, 0.2, 0, [100])])
    assert over_episodes(cells, "cost", np.median).mean == 1.5
    assert over_episodes(cells, "cost", np.max).mean == 100
    assert over_episodes(cells.choose([]), "cost", np.max).mean is None


def test_worlds_that_one_side_lacks_are_in_no_pair() -> None:
    own = one_cell(CellIdentity("goal1", "ida", "full", "noisy", 0.2, 0), [1, 2, 3], cost=[5, 7, 9])
    human = CellIdentity("goal1", "human", "full", "noisy", 0.2, 0)
    assert paired_difference(own, one_cell(human, [3, 2, 8], cost=[1, 1, 50]), "cost") == 7.0
    assert paired_difference(own, one_cell(human, [8, 9], cost=[1, 1]), "cost") is None


# Counterfactual branches beside the other numbers of a cell.


def of_method(frame: Frame, method: str) -> CellTable:
    return frame.cells.where(lambda cell: cell.method == method)


def branches_of(grid: Grid, method: str) -> list[Path]:
    """The tables of branches of the cells of a method."""
    keys = [cell.branches for cell in grid.cells if cell.method == method]
    return [grid.layout.artifact(BRANCHES, key) / BRANCHES_FILE for key in keys if key is not None]


def test_columns_are_means_over_the_branched_interventions_of_an_episode(grid: Grids) -> None:
    made = with_invented_branches(grid(seeds=(0,)), stride=2)
    frame = made.read()
    assert frame.unbranched == ()
    cells = singles(of_method(frame, "ida"))
    for cell, source in zip(cells, branches_of(made, "ida"), strict=True):
        rows = pq.read_table(source).to_pylist()
        pairs = list(zip(rows[::2], rows[1::2], strict=True))
        pooled: dict[str, list[float]] = {name: [] for name in JUDGED}
        for e in range(cell.counts[0]):
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
            assert cell.episodes("branches")[e] == len(own["uir"])
            assert cell.episodes("effective_branches")[e] == len(own["uir_eff"])
            for name, numbers in own.items():
                pooled[name] += numbers
                assert cell.episodes(name)[e] == pytest.approx(
                    np.mean(numbers) if numbers else np.nan, nan_ok=True
                )
        assert {name: cell.pooled(name)[0] for name in JUDGED} == {
            name: pytest.approx(np.mean(numbers)) for name, numbers in pooled.items()
        }
        for name in ("uir", "uir_swapped", "uir_eff"):
            total, mass = cell.weighted(name)
            assert total.sum() / mass.sum() == pytest.approx(cell.pooled(name)[0])


def test_a_cell_without_interventions_defines_nothing(grid: Grids) -> None:
    made = grid(seeds=(0,))
    first = next(cell for cell in made.cells if cell.method == "ida")
    # the first intervention alone
    some = with_invented_branches(made.of(lambda cell: cell == first), stride=10**6)
    cell = some.read().cells
    assert cell.episodes("branches").tolist() == [1.0, 0.0, 0.0, 0.0]
    assert np.isnan(cell.episodes("uir")[1:]).all()
    assert cell.pooled("uir")[0] == cell.episodes("uir")[0]


def test_branches_that_are_not_there_are_named_and_the_cell_stays(grid: Grids) -> None:
    made = with_invented_branches(grid(seeds=(0,)))
    first, second, third, fourth = branches_of(made, "ida")
    first.unlink()
    second.unlink()
    third.write_bytes(third.read_bytes()[:100])
    fourth.write_bytes(branches_of(made, "wasp")[0].read_bytes())
    frame = made.read({second.parent.name: "failed: TrainingError: no tau_R"})
    assert not frame.missing
    assert len(of_method(frame, "ida")) == 4
    reasons = [gap.reason for gap in frame.unbranched]
    assert reasons[:2] == ["not computed yet", "failed: TrainingError: no tau_R"]
    assert "is damaged" in reasons[2]
    assert "the branches of another cell" in reasons[3]
    assert [gap.damaged for gap in frame.unbranched] == [False, False, True, True]
    assert {gap.kind for gap in frame.unbranched} == {"counterfactual"}
    assert all(gap.label.startswith("counterfactual of goal1 ida") for gap in frame.unbranched)
    assert len(frame.judged) == 3 * 4


def test_branches_of_more_episodes_than_the_cell_has_are_refused(grid: Grids) -> None:
    ida = next(cell for cell in grid(seeds=(0,), episodes=5).cells if cell.method == "ida")
    made = with_invented_branches(Grid(grid(seeds=(0,), episodes=5).layout, [ida]))
    grid(seeds=(0,), episodes=4)  # in the place of the larger cells
    (gap,) = made.read().unbranched
    assert "it is about 5 episodes, and the cell has 4" in gap.reason


# Figure 3: as a table and as a picture.


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Frame:
    grid = write_grid(tmp_path_factory.mktemp("grid"), ablations=("safety-only",))
    return with_invented_branches(grid).read()


def row(table: Table, method: str) -> dict[str, float | None]:
    values = next(row.values for row in table.rows if row.labels[1].startswith(method))
    return {column.key: value.mean for column, value in zip(table.columns, values, strict=True)}


def test_a_row_is_the_mean_over_seeds_of_its_cells(judged: Frame) -> None:
    found = row(necessity_table(judged), "IDA")
    cells = of_method(judged, "ida")
    by_seed = [cells.pooled("uir")[cells.seeds == seed].mean() for seed in (0, 1, 2)]
    assert found["uir"] == pytest.approx(np.mean(by_seed))
    assert found["interventions"] == cells.episodes("intervened").sum()
    assert found["branched"] == found["interventions"]
    assert "Human-only" not in {
        label for row in necessity_table(judged).rows for label in row.labels
    }


def test_a_sample_is_told_and_so_is_a_small_one(grid: Grids) -> None:
    table = necessity_table(with_invented_branches(grid(seeds=(0,)), stride=12).read())
    found = row(table, "WASP")
    assert found["interventions"] == 4 * 20
    assert found["branched"] == 4 * 2
    assert any(
        note.startswith(
            "Fewer than 30 interventions were branched of IDA, Diffusion, SafeRL-Res, WASP:"
        )
        for note in table.notes
    )


def test_rows_without_all_branches_are_partial_and_never_best(grid: Grids) -> None:
    made = with_invented_branches(grid(seeds=(0, 1)))
    table = necessity_table(made.read())
    best = {table.rows[r].labels[1] for r, c in table.marks if table.columns[c].key == "uir"}
    assert best == {"WASP"}
    branches_of(made, "wasp")[0].unlink()
    partial = necessity_table(made.read())
    assert "WASP [7 of 8 cells]" in {row.labels[1] for row in partial.rows}
    assert not any(partial.rows[r].labels[1].startswith("WASP") for r, _ in partial.marks)
    assert any(
        note.startswith("INCOMPLETE: 1 cell has no counterfactual branches")
        for note in partial.notes
    )


def test_without_counterfactuals_there_is_neither_table_nor_figure(
    grid: Grids, tmp_path: Path
) -> None:
    frame = grid(seeds=(0,)).read()
    assert necessity_table(frame) is None
    assert necessity_figure(frame, tmp_path / "none") == []


def test_the_classes_of_risk_have_the_shares_of_the_table(
    grid: Grids, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = grid(seeds=(0, 1))
    drawn: list[Any] = []
    even = with_invented_branches(Grid(made.layout, made.cells[::2]))
    odd = with_invented_branches(Grid(made.layout, made.cells[1::2]), stride=3)
    frame = Grid(made.layout, [*even.cells, *odd.cells]).read()
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
