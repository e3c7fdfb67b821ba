"""README, docs/assistants.md and docs/learning.md say what is published: the field, unseen
operators, every trained part.
"""

import json
import runpy
from pathlib import Path

import assistants
import curves
import experts
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trained

from wasp_cli.operators.delayed import delay_steps

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "assistants.md").read_text(encoding="utf-8")


def test_the_tables_of_results_are_the_published_rows():
    field, (moderate, unseen, _) = assistants.published("field"), assistants.GROUPS
    assert assistants.table(field, moderate) in PAGE
    assert assistants.differences(field, moderate) in PAGE
    met = assistants.published("unseen")
    assert assistants.table(met, unseen) in PAGE
    assert assistants.differences(met, unseen) in PAGE
    cells, words = assistants.sums_of(met), " ".join(PAGE.split())
    for group, told in (
        (unseen, "WASP costs {} % of what IDA"),
        (moderate, "it costs {} % of IDA's in this training"),
    ):
        by = [
            [
                assistants.cube(cells, task, name, assistants.GROUPS[group])
                for name in ("wasp", "ida")
            ]
            for task in assistants.TASKS_SHOWN[:3]
        ]
        shares = [
            100 * assistants.measures(ours)["cost"] / assistants.measures(ida)["cost"]
            for ours, ida in by
        ]
        assert told.format("{:.0f}, {:.0f} and {:.0f}".format(*shares)) in words
    assert "12.1 / 118.3" in assistants.matrix(met)
    assert assistants.matrix(assistants.published("operators")) in PAGE


def test_a_goal_that_only_the_operator_knows():
    rows = assistants.published("goal1-two")
    assert assistants.table(rows, next(iter(assistants.GROUPS))) in PAGE
    differences = assistants.differences(rows, next(iter(assistants.GROUPS)))
    assert all(
        less in differences
        for less in ("-2.4 [-3.3, -1.4]", "-10.1 [-15.7, -5.7]", "-1.7 [-2.6, -0.8]")
    )
    wrong: dict[str, list[float]] = {}
    for path in (DOCS.parent / "results" / "published" / "store" / "evaluate").glob(
        "*/_manifest.json"
    ):
        manifest = json.loads(path.read_text())
        if manifest["task"] == "goal1-two":
            wrong.setdefault(manifest["axes"]["method"], []).append(
                manifest["summary"]["wrong_goals"]
            )
    names = {
        "human": "operators alone",
        "saferl": "SafeRL-Res",
        "csa": "CSA",
        "wasp": "WASP",
        "ida": "IDA",
        "diffusion": "Diffusion",
    }
    told = ", ".join(f"{name} {np.mean(wrong[method]):.1f}" for method, name in names.items())
    assert told in " ".join(PAGE.split())


def test_the_table_of_the_readme_is_table_1():
    assert assistants.short(assistants.published("table1")) in (
        DOCS.parent / "README.md"
    ).read_text(encoding="utf-8")


def test_reaction_times_are_whole_decisions():
    cars = ", ".join(
        f"{delay_steps(seconds, 0.16) * 0.16:.2f}" for seconds in (0.16, 0.24, 0.40)
    ).replace("0.", ".")
    assert f"in whole decisions (cars: {cars} s) | 0.16, 0.24, 0.40 s |" in PAGE


def test_the_tables_of_experts_and_of_trained_parts_are_the_published_ones():
    page, tasks = (DOCS / "learning.md").read_text(encoding="utf-8"), trained.trained()
    assert list(tasks) == list(trained.TASKS)
    assert trained.table(tasks) in page
    assert experts.table() in page


def test_the_rule_chooses_the_least_intervention_that_keeps_the_return():
    rows = pq.read_table(curves.published("field"))
    assert curves.shown(rows) in PAGE
    points = [
        [curves.point(rows, task, "wasp", value) for value in curves.KNOBS["wasp"].values]
        for task in curves.shown_tasks(rows)
    ]
    ends = [
        end(at[name] for at in each)
        for each in points
        for name in ("return", "cost")
        for end in (min, max)
    ]
    told = (
        "{} to {} at a cost of {} to {} on Race1, {} to {} at {} to {} on FormulaOne1 and {} "
        "to {} at {} to {} on Goal1"
    )
    assert told.format(*(f"{number:.1f}" for number in ends)) in " ".join(PAGE.split())


def test_ida_moves_with_its_knob_at_the_median_too(monkeypatch):
    monkeypatch.setattr(
        curves, "build_assistant", lambda method, config, parts: parts.thresholds["tau_q"]
    )
    parts = curves.Parts(None, None, {}, {"tau_q": 0.0, "margin_p95": 0.03}, 0.99, 0.95, 0.95)
    assert [curves.turned("ida-least", value, parts, {}) for value in (0.0, 1.0, 2.0)] == [
        0.0,
        0.03,
        0.06,
    ]


def test_curves_that_are_not_published_are_a_usage_error(monkeypatch):
    monkeypatch.setattr("sys.argv", ["curves.py", "table1"])
    with pytest.raises(
        SystemExit,
        match=r"table1-curves\.parquet is not there\n(.|\n)*curves\.py field RESULTS TASK",
    ):
        runpy.run_path(curves.__file__, run_name="__main__")


def test_numbers_of_a_table_are_means_over_operators_of_what_is_pooled_over_worlds():
    numbers = {
        "return": 1.0,
        "success": 1.0,
        "cost": 4.0,
        "deviation": 2.0,
        "branched": 4,
        "unnecessary": 1,
        "swapped": 2,
    }
    cells = [("noisy", 0, 10, 5), ("noisy", 1, 30, 3), ("laggy", 0, 10, 0), ("laggy", 1, 10, 2)]
    rows = pa.Table.from_pylist(
        [
            {
                "task": "goal1",
                "method": "ida",
                "operator": operator,
                "seed": 310,
                "episode": episode,
                "decisions": decisions,
            }
            | {"intervened": intervened, "effective": intervened, **numbers}
            for operator, episode, decisions, intervened in cells
        ]
    )
    sums = assistants.cube(assistants.sums_of(rows), "goal1", "ida", ("noisy", "laggy"))
    assert sums.shape == (2, 2, 3 + len(assistants.SUMS))
    found = assistants.measures(sums)
    assert found["intervened"] == pytest.approx((8 / 40 + 2 / 20) / 2)
    assert found["deviation"] == pytest.approx((4 / 40 + 4 / 20) / 2)
    assert (found["uir"], found["mirror"], found["success"]) == pytest.approx((0.25, 0.5, 100.0))
    # the published rows have no times
    assert [name for name, value in found.items() if np.isnan(value)] == ["ms"]
    timed = rows.append_column("ms", pa.array([4.0, 6.0, 1.0, 3.0]))
    times = assistants.measures(
        assistants.cube(assistants.sums_of(timed), "goal1", "ida", ("noisy", "laggy"))
    )
    assert times["ms"] == pytest.approx(3.5)
    assert "| ms |" in assistants.table(timed, "Operators on which choices were made")
