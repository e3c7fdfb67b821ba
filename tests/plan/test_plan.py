import json

import pytest
from rich.console import Console

from tests.plan.test_grid import grid
from wasp_cli.plan.plan import Plan, make_plan, plan_against
from wasp_cli.plan.text import show
from wasp_cli.run.session import _take_back
from wasp_cli.store.artifact import commit, exists, staging_folder


def text_of(plan: Plan, workers: int = 2, *, every: bool = False) -> str:
    console = Console(width=200, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    show(plan, console, workers, every=every)
    return console.export_text()


def test_times_come_from_nodes_of_the_same_sort():
    laid_out = grid(seeds=[0], methods=["human", "expert"])
    seconds = {node.sort: 10.0 for node in laid_out.nodes}
    plan = make_plan(laid_out, {}, {}, seconds)
    # expert, dataset, world model, latents and policies follow one another; the four evaluations
    # share two workers
    assert plan.estimate(2) == (pytest.approx(5 * 10 + 4 * 10 / 2), 0)
    assert plan.estimate(100) == (pytest.approx(6 * 10), 0)
    expert = laid_out.nodes[0].sort
    assert make_plan(laid_out, {}, {}, {expert: 10.0}).estimate(2) == (
        10.0,
        len(laid_out.nodes) - 1,
    )


def test_the_plan_reads_well():
    laid_out = grid(tasks=["race1", "goal1"])
    text = text_of(make_plan(laid_out, {}, {laid_out.nodes[-1].key: "no luck"}))
    assert "48 grid points, 40 cells to evaluate" in text
    assert "failed before: no luck" in text
    assert "no time estimate" in text
    done = make_plan(
        laid_out, {node.kind: {node.key for node in laid_out.nodes} for node in laid_out.nodes}, {}
    )
    assert "nothing to run" in text_of(done)


def test_the_plan_as_json_names_every_cell_and_node():
    laid_out = grid()
    record = json.loads(json.dumps(make_plan(laid_out, {}, {}).as_json()))
    keys = {node["key"] for node in record["nodes"]}
    assert {cell["key"] for cell in record["cells"]} <= keys
    assert {part["key"] for part in record["parts"]} == {
        node["key"] for node in record["nodes"] if node["kind"] not in ("evaluate", "calibration")
    }
    assert all(set(node["needs"].values()) <= keys for node in record["nodes"])
    assert record["counts"] == {"missing": len(keys)}


def test_a_damaged_artifact_is_computed_again(layout):
    laid_out = grid()
    node, other, _ = nodes = laid_out.nodes[:3]
    for each in nodes:
        folder = staging_folder(layout, each.key)
        (folder / "data.bin").write_bytes(b"12345")
        commit(layout, each.kind, each.key, folder, {})
    assert plan_against(laid_out, layout).count("cached") == 3
    (layout.artifact(node.kind, node.key) / "data.bin").write_bytes(b"123")
    layout.manifest(other.kind, other.key).unlink()
    plan = plan_against(laid_out, layout)
    step, without_manifest = (
        next(step for step in plan.steps if step.node == each) for each in (node, other)
    )
    assert (step.state, step.runs, without_manifest.state) == ("damaged", True, "damaged")
    assert "data.bin' has 3 bytes, not 5" in step.reason
    assert "data.bin' has 3 bytes, not 5" in text_of(plan)
    assert plan.count("cached") == 1
    (layout.artifact(node.kind, node.key) / "data.bin").write_bytes(b"12345")
    _take_back(plan, layout)
    assert exists(layout, node.kind, node.key), "another run has repaired it since"
