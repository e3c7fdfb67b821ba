"""A look at the first episodes of every cell before the whole."""

import json
from pathlib import Path
from typing import Any

import pytest

from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.run.pool import InlinePool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner
from wasp_cli.spec.derived import limited
from wasp_cli.spec.load import Loaded, load
from wasp_cli.store.layout import Layout

METHODS = {"human", "ida", "wasp", "expert"}
"""Of the small spec."""


def loaded_with(spec: Path, limit: int | None, *settings: str) -> Loaded:
    return limited(load(spec, ("episodes=30", *settings)), limit)


def planned(loaded: Loaded, layout: Layout) -> Plan:
    return plan_against(lay_out(loaded.spec), layout)


def carried_out(loaded: Loaded, layout: Layout) -> dict[str, dict[str, Any]]:
    """Compute what is missing; returns the manifests of the cells of this run by label."""
    layout.prepare()
    plan = planned(loaded, layout)
    assert Runner(layout, new_run(layout, loaded, plan), InlinePool()).run(plan).complete
    manifests = [json.loads(layout.manifest(node.kind, node.key).read_text()) for node in plan.to_run() if node.kind == "evaluate"]
    return {manifest["label"]: manifest for manifest in manifests}


def test_a_limited_cell_is_not_the_whole_one_and_the_whole_one_goes_on_from_it(fakes, small_spec, tmp_path):
    layout = Layout(tmp_path / "results")
    look, all_ = loaded_with(small_spec, 10), loaded_with(small_spec, None)
    first = carried_out(look, layout)
    assert {manifest["config"]["episodes"] for manifest in first.values()} == {10}
    assert not any("earlier" in manifest["provenance"] for manifest in first.values())
    assert planned(look, layout).to_run() == []

    plan = planned(all_, layout)
    cells = {node.key for node in plan.to_run() if node.kind == "evaluate"}
    assert cells == plan.begun.keys()
    assert {node.kind for node in plan.to_run()} <= {"evaluate", "counterfactual"}  # nothing is trained again
    whole = carried_out(all_, layout)
    assert whole.keys() == first.keys()
    for label, manifest in whole.items():
        assert manifest["config"]["episodes"] == 30
        assert manifest["key"] != first[label]["key"]
        assert manifest["provenance"]["earlier"] == first[label]["key"]
    again = planned(all_, layout)
    assert again.to_run() == []
    assert again.seconds.keys().isdisjoint(node.sort for _, node in again.grid.cells), "a part of a cell was taken for its time"


@pytest.mark.parametrize(
    ("setting", "methods"),
    [
        ("evaluate.safe_cost=25.0", METHODS),
        ("side_by_side=5", set()),
        ("evaluate.safe_cost=3.0", set()),
        ("wasp.candidates=9", METHODS - {"wasp"}),
    ],
)
def test_a_cell_that_differs_in_anything_else_is_no_beginning(setting, methods, fakes, small_spec, tmp_path):
    layout = Layout(tmp_path / "results")
    carried_out(loaded_with(small_spec, 10), layout)
    plan = planned(loaded_with(small_spec, None, setting), layout)
    assert {node.axes["method"] for node in plan.to_run() if node.key in plan.begun} == methods
