from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.report.claims.test_verdict import cell, frame_of
from tests.report.invented import Grid, invent, write
from tests.report.made import NO_CELLS, frame_of_tables, renamed
from tests.report.swept import invent_sweep, keyed
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.table import CellTable
from wasp_cli.report.bootstrap import difference_of, improvement_over, iqm_of
from wasp_cli.report.figures import cost_return_figure
from wasp_cli.report.stats import Frame
from wasp_cli.report.summary import Value, same_episodes
from wasp_cli.report.sweep import CHOICE, DIFFERENCE, UNTOUCHED_NOTE, SweepReport, Swept, lines
from wasp_cli.report.tables import Row, Table
from wasp_cli.report.tables import main as tables
from wasp_cli.report.tables.comparison import MEASURES, comparison_table
from wasp_cli.report.tables.main import (
    ablation_table,
    detail_table,
    latency_table,
    main_table,
    operator_table,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, read_episodes

Grids = Callable[..., Grid]


def row(table: Table, *labels: str) -> Row:
    return next(row for row in table.rows if row.labels == labels)


def value(table: Table, key: str, *labels: str) -> Value:
    return row(table, *labels).values[[column.key for column in table.columns].index(key)]


def test_numbers_are_those_of_the_main_table_and_of_the_bootstrap(frame: Frame) -> None:
    table, main = comparison_table(frame), main_table(frame)
    by_method = {group.method: group.cells for group in frame.groups if group.variant == "full"}
    wasp, human = by_method["wasp"], by_method["human"]
    for measure in MEASURES:
        labels = ("Goal1", measure.heading, "WASP")
        assert value(table, "mean", *labels).mean == value(main, measure.key, "Goal1", "WASP").mean
        middle, change = iqm_of(wasp, measure.key), difference_of(wasp, human, measure.key)
        wins = improvement_over(wasp, human, measure.key, measure.better)
        for key, estimate in (("iqm", middle), ("difference", change), ("improvement", wins)):
            assert (value(table, key, *labels).mean, value(table, key, *labels).interval) == (
                estimate.value,
                estimate.interval,
            )


def test_what_is_resampled_is_said(frame: Frame, grid: Grids) -> None:
    three = comparison_table(frame).notes
    assert (
        "[low, high]: range of three trainings, by a bootstrap with 2000 resamples of the "
        "trainings, each with its models and worlds; "
        "10 resamples differ, so they are coarse."
    ) in three
    assert not any("95 %" in note for note in three)
    assert (
        "These are 80 intervals; of so many some miss even where nothing differs. Decide "
        "beforehand which comparison counts." in three
    )
    one = comparison_table(grid(seeds=(0,)).read()).notes
    assert any(
        note.startswith("[low, high]: 95 % interval over 4 worlds, ") and "not retraining" in note
        for note in one
    )
    together = frame_of_tables(renamed(grid().read().cells, lambda _: {"training_seed": 7}))
    (note,) = [note for note in comparison_table(together).notes if "[low, high]" in note]
    # every invented seed has the same four
    assert note.startswith("[low, high]: 95 % interval over 4 worlds, ")
    single = comparison_table(grid(seeds=(0,), episodes=1).read())
    impaired = grid(seeds=(0, 1)).of(lambda one: one.operator in ("noisy", "laggy")[: 1 + one.seed])
    for table in (single, comparison_table(impaired.read())):
        assert (
            "No intervals: there is a single world to resample, or the trainings have "
            "cells of different operators." in table.notes
        )
    assert all(each.interval is None for row in single.rows for each in row.values)


def test_gaps(grid: Grids) -> None:
    assert comparison_table(Frame(NO_CELLS)) is None
    made = grid(seeds=(0, 1))
    for place, one in enumerate(made.cells):
        if one.method == "human" or (one.method, one.seed) == ("saferl", 0):
            made.rows(place).unlink()
    table = comparison_table(made.read())
    assert "The reference has no cells here, so that nothing is compared with it." in table.notes
    assert any(note.startswith("INCOMPLETE: 12 of 42") for note in table.notes)
    # worlds of its only seed
    assert row(table, "Goal1", "Cost ↓", "SafeRL-Res [4 of 8 cells]").values[0].interval is not None


def test_latency_is_over_episodes(frame: Frame) -> None:
    wasp = frame.cells.where(lambda cell: (cell.method, cell.variant) == ("wasp", "full"))
    times = np.concatenate([np.arange(4.0) + 10 * place for place in range(len(wasp))])
    table = latency_table(frame_of_tables(wasp.with_columns({"decision_p95_ms": times})))
    assert [each.mean for each in row(table, "Goal1", "WASP").values] == [
        2.0,
        2.0,
        np.median(times),
        113.0,
    ]
    unknown = np.full(len(times), np.nan)
    untimed = wasp.with_columns({"decision_p50_ms": unknown, "decision_p95_ms": unknown})
    assert latency_table(frame_of_tables(untimed)) is None
    assert latency_table(Frame(NO_CELLS)) is None


# Ablations of WASP stay among ablations and say of how many episodes they changed nothing; the
# printed WASP is a method of its own.


TITLE = "WASP, no Case II recovery"


def labels(table: Table | None) -> list[str]:
    return [label for row in table.rows for label in row.labels]


def test_an_ablation_has_no_row_in_the_tables_and_figures_of_the_methods(
    grid: Grids, tmp_path: Path
) -> None:
    frame = grid(ablations=("no-case2",)).read()
    for make in (
        main_table,
        detail_table,
        latency_table,
        operator_table,
        tables.severity_table,
        comparison_table,
    ):
        assert "WASP" in labels(make(frame))
        assert TITLE not in labels(make(frame))
    assert {"WASP, full", TITLE} <= set(labels(ablation_table(frame)))
    assert {"WASP", TITLE} <= set(labels(tables.threshold_table(frame)))
    pictures = [path for path in cost_return_figure(frame, tmp_path) if path.suffix == ".svg"]
    assert len(pictures) == 1
    assert not any(TITLE in path.read_text() for path in pictures)


def wasp(costs: list[float], variant: str = "full", seed: int = 0, **more: Any) -> CellTable:
    return cell("wasp", costs, seed, variant=variant, **{"mag": [0.1] * len(costs), **more})


def test_equal_in_all_that_happened_and_in_the_same_world() -> None:
    full = wasp([1.0, 2.0, 3.0])
    assert same_episodes(wasp([1.0, 2.0, 3.0], "no-case2"), full) == (3, 3)
    assert same_episodes(wasp([1.0, 2.5, 3.0], "no-case2"), full) == (2, 3)
    assert same_episodes(wasp([1.0, 2.0, 3.0], "no-case2", mag=[0.1, 0.1, 0.2]), full) == (2, 3)
    assert same_episodes(wasp([1.0, 2.0, 3.0], "no-case2", mag=[0.1, np.nan, 0.1]), full) == (
        2,
        3,
    )
    assert same_episodes(wasp([1.0, 2.0, 3.0, 4.0], "no-case2"), full) == (3, 3)
    assert same_episodes(wasp([1.0, 2.0, 3.0], "no-case2", seed=1), full) == (0, 0)


@pytest.mark.parametrize(
    ("costs", "note"), [([1.0, 2.0, 7.0], "2 of 3 episodes"), ([5.0, 6.0, 7.0], "")]
)
def test_the_table_says_it_where_there_are_any(costs: list[float], note: str) -> None:
    columns = {name: [0.0] * 3 for name in ("return", "success", "viol", "int_rate")}
    table = ablation_table(
        frame_of(wasp([1.0, 2.0, 3.0], **columns), wasp(costs, "no-case2", **columns))
    )
    found = [text for text in table.notes if "the same as with the full method" in text]
    assert [text.partition(" are ")[0] for text in found] == (
        [f"Goal1, WASP, no Case II recovery: {note}"] if note else []
    )
    # gates may differ
    assert all(text.endswith("method in what happened and what was corrected.") for text in found)


# The tables of a sweep against numbers worked out by hand (tests/report/swept.py says how).


KEY = "diffusion.ratio"
LOST = CellIdentity("goal1", "diffusion", "full", "noisy", 0.6, 1)


@pytest.fixture
def swept(tmp_path: Path) -> list[Swept]:
    return invent_sweep(tmp_path)


def printed(table: Table, *columns: str) -> list[tuple[str, ...]]:
    """The labels of every row, and some of its cells without the spread."""
    shown = [(c, column) for c, column in enumerate(table.columns) if column.key in columns]
    return [
        (*row.labels, *(column.cell(row.values[c], spread=False) for c, column in shown))
        for row in table.rows
    ]


def test_a_row_for_each_value_and_one_for_what_the_setting_does_not_touch(
    swept: list[Swept],
) -> None:
    table = SweepReport("s", "spec", KEY, tuple(swept)).table
    assert table.labels == ("Task", "Method", KEY)
    # Two operators and two seeds: a return of 7 and 6, 2 of 2 and 2 of 2 successes, and one goal
    # more with every value.
    assert printed(table, "return", "success", "int_rate", "mag", "mag_int") == [
        ("Goal1", "Human-only", "-", "6.50", "100.0", "0.00", "0.00", "n/a"),
        ("Goal1", "Diffusion", "0", "6.50 (+0.00)", "100.0 (+0.0)", "0.10", "0.06", "0.62"),
        ("Goal1", "Diffusion", "0.20", "7.50 (+1.00)", "100.0 (+0.0)", "0.20", "0.12", "0.62"),
        ("Goal1", "Diffusion", "0.6", "8.50 (+2.00)", "100.0 (+0.0)", "0.30", "0.19", "0.62"),
    ]
    assert {UNTOUCHED_NOTE, DIFFERENCE} <= set(table.meanings)
    assert CHOICE in table.notes


def test_a_method_is_touched_when_one_of_its_cells_is(swept: list[Swept]) -> None:
    first = swept[0]
    swept[0] = Swept(first.text, first.value, keyed(first.frame, "another", "human"))
    assert [(line.group.method, line.text) for line in lines(swept)][:3] == [
        ("human", "0"),
        ("human", "0.20"),
        ("human", "0.6"),
    ]


def test_a_missing_cell_belongs_to_its_value_alone(tmp_path: Path) -> None:
    swept = invent_sweep(tmp_path, missing=[LOST])
    report = SweepReport("s", "spec", KEY, tuple(swept))
    table = report.table
    assert [row.labels[1:] for row in table.rows[1:3]] == [
        ("Diffusion [3 of 4 cells]", "0"),
        ("Diffusion", "0.20"),
    ]
    assert any(
        note.startswith("INCOMPLETE: 1 of 16 cells are missing (1 not computed).")
        for note in table.notes
    )
    assert [gap.label for gap in report.missing] == [
        "goal1 diffusion noisy=0.6 seed 1 [diffusion.ratio=0]"
    ]


def test_a_task_of_ones_own_has_its_cost_per_step_since_who_dies_early_looks_safe(
    tmp_path: Path,
) -> None:
    lengths = {"human": 40, "wasp": 10}
    layout = Layout(tmp_path)
    cells = [
        write(
            layout,
            CellIdentity("puddle:Puddle-v0", method, "full", "noisy", 0.4, 0),
            [invent(0, 2, 0.0, 0.3, steps) for _ in range(2)],
        )
        for method, steps in lengths.items()
    ]
    made = Grid(layout, cells)
    table = main_table(made.read())
    for place, own in enumerate(cells):
        rows = read_episodes([made.rows(place)]).to_pylist()
        rate = sum(row["cost"] for row in rows) / sum(row["env_steps"] for row in rows)
        found = value(table, "viol_env", *labels_of_cell(table, own))
        assert found.mean == pytest.approx(rate)
    assert "Cost/1000" in [column.title for column in table.columns]


def labels_of_cell(table: Table, cell: RecordedCell) -> tuple[str, ...]:
    title = {"human": "Human-only", "wasp": "WASP"}[cell.method]
    return next(row.labels for row in table.rows if row.labels[1] == title)


def test_tasks_of_the_package_have_no_column_more(frame: Frame) -> None:
    assert "viol_env" not in [column.key for column in main_table(frame).columns]
