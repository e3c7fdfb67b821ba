"""What a report says of predicted and realised gains, of a small store and of invented rows."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.report.golden_store import STORE, report_of
from tests.report.made import NO_CELLS
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.report.gains import Foreseen, Foresight, foresight_of
from wasp_cli.report.gains_figure import gains_figure
from wasp_cli.report.stats import Frame
from wasp_cli.report.summarize import Report
from wasp_cli.report.tables.gains import gains_table
from wasp_cli.store.branches import read_branches
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import read_steps


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    return report_of(shutil.copytree(STORE, tmp_path_factory.mktemp("gains") / "results"))


@pytest.fixture(scope="module")
def invented(report: Report) -> Foresight:
    """Six interventions in each of eight worlds, half of them of either gate. What is predicted
    comes true by half, with a little of either sign beside it.
    """
    random = np.random.default_rng(3)
    world = np.repeat(np.arange(8.0), 6)
    gate = np.tile([GATE_SAFETY, GATE_TASK], 24)
    gains = {name: 0.1 + random.exponential(1.0, len(world)) for name in ("gain", "saved")}
    real = {name: 0.5 * each + random.normal(0, 0.05, 48) for name, each in gains.items()}
    cell = Foreseen(gains, real, gate, world, branched=60)
    return Foresight({judged_cells(report)[0]: cell})


def judged_cells(report: Report) -> list[str]:
    """The keys of the cells of whole WASP that have branches."""
    wasp = report.frame.cells.where(lambda cell: (cell.method, cell.variant) == ("wasp", "full"))
    return [cell.key for cell in wasp if cell.key in report.frame.judged]


def test_predictions_and_branches_of_a_decision_come_together(report: Report) -> None:
    compared = 0
    cells = {cell.key: cell for cell in report.frame.cells}
    for key, foreseen in report.foresight.cells.items():
        folder = report.layout.store
        evaluation = folder / "evaluate" / key / "episodes.parquet"
        steps = {(row["episode"], row["t"]): row for row in read_steps(evaluation).to_pylist()}
        path = folder / "counterfactual" / cells[key].branches / "branches.parquet"
        stored = read_branches(path)
        assert foreseen.branched == len(stored.t)
        decisions = list(zip(stored.episode.tolist(), stored.t.tolist(), strict=True))
        known = [i for i, each in enumerate(decisions) if steps[each]["plan_return"] is not None]
        for row, i in enumerate(known):
            step, weights = steps[decisions[i]], 0.95 ** np.arange(stored.cell.window)
            saved = (stored.cost["cf"][i] - stored.cost["asst"][i]) * weights
            assert foreseen.realised["saved"][row] == pytest.approx(saved.sum())
            gain = step["plan_return"] - step["alone_return"]
            assert foreseen.predicted["gain"][row] == pytest.approx(gain)
            compared += 1
    assert compared > 5
    # methods without a model predict nothing
    assert {cells[key].method for key in report.foresight.cells} == {"wasp"}


def test_a_report_of_a_small_result_draws_them_and_has_the_table(
    report: Report, tmp_path: Path
) -> None:
    files = gains_figure(report.frame, report.foresight, tmp_path)
    assert [path.name for path in files] == ["gains.png", "gains.svg"]
    assert "gains" in {table.name for table in report.further}
    drawn = files[1].read_text(encoding="utf-8")
    assert all(text in drawn for text in ("Goal1: WASP", "cost saved, predicted", "realised"))
    assert "](gains.png)" in report.markdown([path.name for path in files])


def test_slope_threshold_and_tau_r_are_in_the_picture(
    report: Report, invented: Foresight, tmp_path: Path
) -> None:
    table = gains_table(report.frame, invented)
    assert table is not None
    keys = [column.key for column in table.columns]
    returns, costs = (dict(zip(keys, row.values, strict=True)) for row in table.rows)
    assert (returns["interventions"].mean, returns["worlds"].mean) == (24.0, 8.0)
    assert returns["slope"].mean == pytest.approx(0.5, abs=0.1)
    assert returns["slope"].interval is not None
    assert returns["slope"].interval.low < 0.5 < returns["slope"].interval.high
    task = invented.cells[judged_cells(report)[0]]
    assert returns["holds_from"].mean == task.predicted["gain"][task.gate == GATE_TASK].min()
    assert costs["tau_r"].mean is None
    assert any(note.startswith("48 of 60 branched interventions") for note in table.notes)
    one, other = tmp_path / "one", tmp_path / "other"
    one.mkdir()
    other.mkdir()
    files = gains_figure(report.frame, invented, one)
    again = gains_figure(report.frame, invented, other)
    assert [path.read_bytes() for path in files] == [path.read_bytes() for path in again]
    drawn = files[1].read_text(encoding="utf-8")
    assert all(text in drawn for text in ("as predicted", "τ_r", "mean above 0", "slope 0."))


def test_without_branches_or_predictions_there_is_neither_table_nor_figure(
    report: Report, tmp_path: Path
) -> None:
    unbranched = replace(report.frame, judged={})
    nothing = foresight_of(report.layout, unbranched)
    assert not nothing.cells
    assert not nothing.unread
    for frame in (unbranched, Frame(NO_CELLS)):
        assert gains_table(frame, nothing) is None
        assert gains_figure(frame, nothing, tmp_path) == []


def test_steps_that_are_gone_are_no_predictions_and_damaged_ones_are_named(
    report: Report, tmp_path: Path
) -> None:
    layout = Layout(shutil.copytree(report.layout.root, tmp_path / "results"))
    first, second = list(report.foresight.cells)[:2]
    (layout.store / "evaluate" / first / "_steps.pq").unlink()
    damaged = layout.store / "evaluate" / second / "_steps.pq"
    damaged.write_bytes(damaged.read_bytes()[:400])
    found = foresight_of(layout, report.frame)
    assert report.foresight.cells.keys() - found.cells.keys() == {first, second}
    assert len(found.unread) == 1
    assert str(damaged) in found.unread[0]
    table = gains_table(report.frame, found)
    assert table is not None
    assert any(str(damaged) in note for note in table.notes)
