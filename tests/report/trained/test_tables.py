"""Tables of the trained parts, and the pages of single ones."""

import json
from typing import Any

import numpy as np

from tests.learning.recordings import SOURCES, recording
from tests.report.trained.parts import artifact, diagnosed
from wasp_cli.learning.contents import contents
from wasp_cli.plan.node import Part
from wasp_cli.report.render import csv_text, markdown
from wasp_cli.report.tables import Table
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.datasets import dataset_warnings, with_warnings
from wasp_cli.report.trained.evidence import contents_markdown, open_loop_markdown
from wasp_cli.report.trained.figures import STEPS
from wasp_cli.report.trained.tables import training_tables
from wasp_cli.stages.diagnostics import SHOWN
from wasp_cli.store.layout import Layout

SUMMARIES: dict[str, dict[str, Any]] = {
    "expert": {"return": 20.0, "cost": 30.0, "success": 0.9, "multiplier": 0.4},
    "dataset": {"steps": 1000, "costly_share": 0.05},
    "world_model": {"skipped": 0},
    "diagnostics": {"auprc@1": 0.8, "auprc@5": None, "reward_r2@5": 0.3},
    "policies": {"return": 18.0, "cost": 33.0, "privileged_return": 20.0, "privileged_cost": 30.0},
    "critics": {"rank_r": 0.7, "rank_c": None},
}
Parts = list[tuple[Part, str]]


def chain(seeds: tuple[int, ...] = (0,), task: str = "goal1") -> tuple[Parts, list[Trained]]:
    """Every part of a chain with its artifact; a later seed has other numbers."""
    parts, trained = [], []
    for seed in seeds:
        for kind in ("expert", "dataset", "world_model", "policies", "critics", "diagnostics"):
            part, key = Part(task, kind, seed), f"{kind}{seed}"
            told = {
                name: value + seed if isinstance(value, float) else value
                for name, value in SUMMARIES[kind].items()
            }
            parts.append((part, key))
            trained.append(Trained(kind, task, seed, key, 1.0, told))
    return parts, trained


def numbers(table: Table, row: int = 0) -> dict[str, float | None]:
    return {
        column.key: value.mean
        for column, value in zip(table.columns, table.rows[row].values, strict=True)
    }


def test_a_chain_is_one_row_of_what_its_stages_tell() -> None:
    stages, ahead = training_tables(*chain())
    assert [row.labels for row in stages.rows] == [("Goal1",)]
    assert numbers(stages) == {
        "expert.return": 20.0,
        "expert.cost": 30.0,
        "expert.success": 0.9,
        "dataset.costly_share": 0.05,
        "policies.return": 18.0,
        "policies.privileged_return": 20.0,
        "policies.cost": 33.0,
        "policies.privileged_cost": 30.0,
        "critics.rank_r": 0.7,
        "critics.rank_c": None,
    }
    assert not stages.notes
    assert (
        "| Goal1 | 20.0 | 30.0 | 90 | 5.0 | 18.0 | 20.0 | 33.0 | 30.0 | 0.70 | n/a |"
        in markdown(stages)
    )
    # Only steps and measures that the stage tells: what it knows to be undefined is shown as such.
    assert [(row.labels[1], [value.mean for value in row.values]) for row in ahead.rows] == [
        ("Cost AUPRC", [0.8, None]),
        ("Reward R²", [None, 0.3]),
    ]
    assert csv_text(ahead).splitlines()[0] == "task,measure,step_1,step_5,seeds"


def test_what_is_missing_is_named_and_never_a_number() -> None:
    parts, trained = chain(seeds=(0, 1))
    there = [
        one
        for one in trained
        if one.stage not in ("critics", "diagnostics")
        and not (one.stage == "expert" and one.seed == 1)
    ]
    stages, ahead = training_tables(parts, there, {"critics0": "failed: no luck"})
    assert stages.rows[0].labels == ("Goal1 [5 of 8 parts]",)
    found = numbers(stages)
    assert (found["expert.return"], found["critics.rank_r"], found["critics.rank_c"]) == (
        20.0,
        None,
        None,
    )
    assert stages.notes == (
        "INCOMPLETE: 5 of 12 parts are missing: goal1 s0 critics (failed: no luck), goal1 "
        "s0 diagnostics, goal1 s1 expert, "
        "goal1 s1 critics, goal1 s1 diagnostics.",
    )
    assert [row.labels for row in ahead.rows] == [("Goal1", "Cost AUPRC [0 of 2 parts]")]
    assert all(value.mean is None for value in ahead.rows[0].values)


def test_datasets_without_enough_costs_or_a_source_are_warned_of() -> None:
    data = recording()
    data.cost[:] = np.arange(36) % 12 == 5
    data.sources[:, 1] = 0
    table = contents(data, SOURCES)
    assert dataset_warnings(table) == [f"no step costs by {SOURCES[1]}"]
    assert f"Warning: no step costs by {SOURCES[1]}." in contents_markdown(table)
    many = contents(data._replace(cost=data.cost * 0 + 1, sources=data.sources * 0 + 1), SOURCES)
    # first rows never cost in a real dataset
    assert dataset_warnings(many) == ["109.1% of the steps cost, not 3% to 15%"]
    few = contents(data._replace(cost=data.cost * 0, sources=data.sources * 0 + 1), SOURCES)
    assert dataset_warnings(few) == ["0.0% of the steps cost, not 3% to 15%"]
    assert dataset_warnings(contents(data._replace(sources=data.sources[:, :0]), ())) == [], (
        "nothing can cost in such a task"
    )


def test_the_report_names_what_is_wrong_with_a_dataset(layout: Layout) -> None:
    one, other = artifact(layout, "dataset"), artifact(layout, "expert")
    assert with_warnings(layout, [one, other]) == (one, other), "nothing is wrong"
    contents_file = layout.artifact("dataset", one.key) / "contents.json"
    table = json.loads(contents_file.read_text())
    table["all"]["costly_share"] = 0.01
    contents_file.write_text(json.dumps(table))
    warned, same = with_warnings(layout, [one, other])
    assert warned.summary == {"warning": "1.0% of the steps cost, not 3% to 15%"}
    assert same == other
    for text in ("{", "[]", '{"all": 3}', '{"all": {"sources": {"a": "x"}, "costly_share": null}}'):
        contents_file.write_text(text)
        assert with_warnings(layout, [one]) == (one,)


def test_the_diagnostics_have_a_section_for_each_set_and_say_what_is_undefined() -> None:
    page = open_loop_markdown(diagnosed())
    assert page.count("\n# ") == 2
    assert "4 episodes (expert 3, noisy 1), imagined 6 steps ahead from 40 moments." in page
    assert "| 2 | 0.100 | 0.100 |" in page
    assert "| 6 | n/a | n/a |" in page
    rows = (
        "filtered latent | 0.50 | 0.75 | n/a",
        "embedding of the image | 0.50 | -0.25 | n/a",
        "imagined, step 5 | 0.50 | 0.75 | n/a",
    )
    assert (
        "\n".join(
            [
                "| read from | all | motion | things |",
                "| --- | ---: | ---: | ---: |",
                *(f"| {row} |" for row in rows),
            ]
        )
        in page
    )
    assert "discounted by 0.95 a step, were above 0.5" in page
    assert "None" not in page
    assert STEPS == SHOWN, "reports show the steps that the stage tells"
