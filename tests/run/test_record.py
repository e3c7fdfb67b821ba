"""What the folder of a run says of it."""

import json
from pathlib import Path

import pytest

from tests.run.recorded import key, planned, write_run
from wasp_cli.cells.runs import last_runs, planned_run, read_run
from wasp_cli.errors import ArtifactError
from wasp_cli.store.layout import Layout

RUN = "20260501-120000-small-0001"
CELL = {
    "task": "goal1",
    "method": "wasp",
    "operator": "noisy",
    "severity": "mild",
    "value": 0.2,
    "seed": 1,
    "key": key(7),
}


def written(layout: Layout, **facts: object) -> None:
    write_run(layout, RUN, [planned(1, "goal1 s1 expert")])
    plan = layout.run(RUN) / "plan.json"
    plan.write_text(json.dumps({**json.loads(plan.read_text()), **facts}))


@pytest.mark.parametrize("name", ["variant", "assistant"])
def test_the_ablation_is_read_by_its_name_and_by_that_of_earlier_versions(
    name: str, tmp_path: Path
) -> None:
    layout = Layout(tmp_path)
    written(layout, cells=[{**CELL, name: "no-case2"}])
    (cell,) = read_run(layout, RUN).cells
    assert cell.variant == "no-case2"
    assert cell.label == "goal1 s1 wasp/no-case2 noisy=0.2"
    assert cell.title == "goal1 wasp/no-case2 noisy=0.2 seed 1"


def test_a_part_that_does_not_read_hides_no_other(tmp_path: Path) -> None:
    layout = Layout(tmp_path)
    written(layout, cells=[{**CELL, "variant": "full", "key": "../../etc"}])
    run = last_runs(layout).runs["small"]
    assert [node.label for node in run.nodes.values()] == ["goal1 s1 expert"]
    with pytest.raises(ArtifactError, match=r"cannot read the plan of run '.*': cells.0.key"):
        _ = run.cells
    written_nodes = layout.run(RUN) / "plan.json"
    written_nodes.write_text(json.dumps({"spec": "small", "nodes": 7, "cells": []}))
    assert planned_run(layout, RUN) is None
    assert last_runs(layout).runs["small"].cells == ()


def test_a_plan_that_names_no_spec_is_damaged(tmp_path: Path) -> None:
    layout = Layout(tmp_path)
    written(layout, spec=None)
    last = last_runs(layout)
    assert not last.runs
    assert "it names no spec" in last.damaged[0]
