from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from wasp_cli.report.bootstrap import difference_of, improvement_over, iqm_of
from wasp_cli.report.stats import Frame, Wanted, groups, read_frame
from wasp_cli.report.summary import Value
from wasp_cli.report.tables.by_axis import severity_table
from wasp_cli.report.tables.comparison import MEASURES, comparison_table
from wasp_cli.report.tables.main import latency_table, main_table
from wasp_cli.report.tables.table import Row, Table

Grid = Callable[..., list[Wanted]]


def found(table: Table | None) -> Table:
    assert table is not None
    return table


def row(table: Table, *labels: str) -> Row:
    return next(row for row in table.rows if row.labels == labels)


def value(table: Table, key: str, *labels: str) -> Value:
    return row(table, *labels).values[[column.key for column in table.columns].index(key)]


def test_numbers_are_those_of_the_main_table_and_of_the_bootstrap(frame: Frame) -> None:
    table, main = found(comparison_table(frame)), main_table(frame)
    by_method = {group.method: group.cells for group in groups(frame) if group.variant == "full"}
    wasp, human = by_method["wasp"], by_method["human"]
    for measure in MEASURES:
        labels = ("Goal1", measure.heading, "WASP")
        assert value(table, "mean", *labels).mean == value(main, measure.key, "Goal1", "WASP").mean
        middle, change = iqm_of(wasp, measure.key), difference_of(wasp, human, measure.key)
        assert measure.better is not None
        wins = improvement_over(wasp, human, measure.key, measure.better)
        for key, estimate in (("iqm", middle), ("difference", change), ("improvement", wins)):
            assert (value(table, key, *labels).mean, value(table, key, *labels).interval) == (estimate.value, estimate.interval)


def test_what_is_resampled_is_said(frame: Frame, grid: Grid) -> None:
    three = found(comparison_table(frame)).notes
    assert (
        "[low, high]: range of three trainings, by a bootstrap with 2000 resamples of the trainings, each with its models and worlds; "
        "10 resamples differ, so they are coarse."
    ) in three
    assert not any("95 %" in note for note in three)
    assert "These are 80 intervals; of so many some miss even where nothing differs. Decide beforehand which comparison counts." in three
    one = found(comparison_table(read_frame(grid(seeds=(0,))))).notes
    assert any(note.startswith("[low, high]: 95 % interval over 4 worlds, ") and "not retraining" in note for note in one)
    together = read_frame([replace(cell, chain_seed=7) for cell in grid()])
    (note,) = [note for note in found(comparison_table(together)).notes if "[low, high]" in note]
    assert note.startswith("[low, high]: 95 % interval over 4 worlds, ")  # every invented seed has the same four
    single = found(comparison_table(read_frame(grid(seeds=(0,), episodes=1))))
    assert "No intervals: there is a single world to resample." in single.notes
    assert all(each.interval is None for row in single.rows for each in row.values)


def test_gaps(grid: Grid) -> None:
    assert comparison_table(Frame(())) is None
    wanted = grid(seeds=(0, 1))
    for cell in wanted:
        if cell.identity.method == "human" or (cell.identity.method, cell.identity.seed) == ("saferl", 0):
            cell.path.unlink()
    frame = read_frame(wanted)
    table = found(comparison_table(frame))
    assert "The reference has no cells here, so that nothing is compared with it." in table.notes
    assert any(note.startswith("INCOMPLETE: 12 of 42") for note in table.notes)
    assert row(table, "Goal1", "Cost ↓", "SafeRL-Res [4 of 8 cells]").values[0].interval is not None  # worlds of its only seed


def test_severities_are_columns(frame: Frame) -> None:
    table = found(severity_table(frame))
    assert [column.title for column in table.columns] == [
        f"{name} {level}" for name in ("Int.", "Cost", "Return") for level in ("mild", "severe")
    ]
    cells = [cell for cell in frame.cells if (cell.identity.method, cell.identity.operator, cell.severity) == ("ida", "laggy", "severe")]
    cells = [cell for cell in cells if cell.identity.variant == "full"]
    assert len(cells) == 3
    assert value(table, "cost.severe", "Goal1", "Laggy", "IDA").mean == pytest.approx(np.mean([cell.pooled["cost"] for cell in cells]))
    assert not any("Expert" in row.labels for row in table.rows)


def test_latency_is_over_episodes(frame: Frame) -> None:
    wasp = [cell for cell in frame.cells if cell.identity.method == "wasp" and cell.identity.variant == "full"]
    times = np.arange(4.0)
    timed = [replace(cell, episodes={**cell.episodes, "decision_p95_ms": times + 10 * i}) for i, cell in enumerate(wasp)]
    table = found(latency_table(Frame(tuple(timed))))
    everything = [10 * i + time for i in range(len(wasp)) for time in times]
    assert [each.mean for each in row(table, "Goal1", "WASP").values] == [2.0, 2.0, np.median(everything), 113.0]
    untimed = {name: np.full(4, np.nan) for name in ("decision_p50_ms", "decision_p95_ms")}
    assert latency_table(Frame(tuple(replace(cell, episodes={**cell.episodes, **untimed}) for cell in wasp))) is None
    assert latency_table(Frame(())) is None
