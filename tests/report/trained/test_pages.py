"""The pages of trained parts in Markdown."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.learning.recordings import SOURCES, recording
from tests.report.trained.parts import QUALITY, artifact, diagnosed
from wasp_cli.learning.contents import contents
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.figures import STEPS
from wasp_cli.report.trained.tables import (
    contents_markdown,
    dataset_warnings,
    open_loop_markdown,
    quality_markdown,
    with_warnings,
)
from wasp_cli.stages.diagnostics import SHOWN
from wasp_cli.store.layout import Layout


def test_a_dataset_has_a_row_for_each_behaviour() -> None:
    page = contents_markdown(contents(recording(), SOURCES))
    assert "| noisy | 1 | 33 | 8 |" in page
    assert SOURCES[1] in page


def test_datasets_without_enough_costs_or_a_source_are_warned_of() -> None:
    data = recording()
    data.cost[:] = np.arange(36) % 12 == 5
    data.sources[:, 1] = 0
    table = contents(data, SOURCES)
    assert dataset_warnings(table) == [f"no step costs by {SOURCES[1]}"]
    assert f"Warning: no step costs by {SOURCES[1]}." in contents_markdown(table)
    many = contents(data._replace(cost=data.cost * 0 + 1, sources=data.sources * 0 + 1), SOURCES)
    assert dataset_warnings(many) == ["109.1% of the steps cost, not 3% to 15%"]  # first rows never cost in a real dataset
    few = contents(data._replace(cost=data.cost * 0, sources=data.sources * 0 + 1), SOURCES)
    assert dataset_warnings(few) == ["0.0% of the steps cost, not 3% to 15%"]
    assert dataset_warnings(contents(data._replace(sources=data.sources[:, :0]), ())) == [], "nothing can cost in such a task"


def test_the_report_names_what_is_wrong_with_a_dataset(tmp_path: Path) -> None:
    layout = Layout(tmp_path)
    one, other = artifact(layout, "dataset"), artifact(layout, "expert")
    assert with_warnings(layout, [one, other]) == (one, other), "nothing is wrong"
    contents_file = layout.artifact("dataset", one.key) / "contents.json"
    table = json.loads(contents_file.read_text())
    table["all"]["costly_share"] = 0.01
    contents_file.write_text(json.dumps(table))
    warned, same = with_warnings(layout, [one, other])
    assert warned.summary == {"warning": "1.0% of the steps cost, not 3% to 15%"}
    assert same == other
    earlier = Trained("dataset", "goal1", 0, one.key, 1.0, {"warning": "as it was written"}, "dataset")
    assert with_warnings(layout, [earlier]) == (earlier,)
    for text in ("{", "[]", '{"all": 3}', '{"all": {"sources": {"a": "x"}, "costly_share": null}}'):
        contents_file.write_text(text)
        assert with_warnings(layout, [one]) == (one,)


def test_the_diagnostics_have_a_section_for_each_set_and_say_what_is_undefined() -> None:
    page = open_loop_markdown(diagnosed())
    assert page.count("\n# ") == 2
    assert "4 episodes (expert 3, noisy 1), imagined 6 steps ahead from 40 moments." in page
    assert "| 2 | 0.100 | 0.100 |" in page
    assert "| 6 | n/a | n/a |" in page
    assert "Share of the costs of each source that were foreseen" in page
    rows = ("filtered latent | 0.50 | 0.75 | n/a", "embedding of the image | 0.50 | -0.25 | n/a", "imagined, step 5 | 0.50 | 0.75 | n/a")
    assert "\n".join(["| read from | all | motion | things |", "| --- | ---: | ---: | ---: |", *(f"| {row} |" for row in rows)]) in page
    assert "Episodes that end there by the task's own rule" in page
    assert "discounted by 0.95 a step, were above 0.5" in page
    assert "None" not in page
    assert "Share of the costs of each source" not in open_loop_markdown(diagnosed(("hazards",)))
    earlier = {name: {key: value for key, value in table.items() if key != "readout"} for name, table in diagnosed().items()}
    assert "read from" not in open_loop_markdown(earlier), "a results folder may hold what was judged before there was a readout"
    assert STEPS == SHOWN, "reports show the steps that the stage tells"


def test_a_denoiser_has_a_row_for_each_kind_of_command_and_ratio() -> None:
    page = quality_markdown(QUALITY)
    assert sum(line.startswith("| ") for line in page.splitlines()) == 2 + 4
    assert "| recorded | 0.4 | 0.250 | 0.300 |" in page


@pytest.mark.parametrize("name", ["a|b", "a\nb"])
def test_names_cannot_break_a_table(name: str) -> None:
    table = contents(recording(), SOURCES)
    page = contents_markdown({**table, name: table["noisy"]})
    (line,) = [line for line in page.splitlines() if line.startswith("| a") and "| all |" not in line]
    assert line.replace("\\|", "").count("|") == page.splitlines()[2].count("|")
