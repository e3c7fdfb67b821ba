"""Why a node runs again, over a real store of fake artifacts."""

from typing import Any

from tests.plan.test_grid import grid
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.reasons import look_at, measured
from wasp_cli.plan.source import source_hashes
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import machine
from wasp_cli.store.published import FROM_PUBLISHED


def store(layout: Layout, node: Node, **changes: Any) -> None:
    """An artifact as a worker leaves it, with changes to its manifest."""
    folder = staging_folder(layout, node.key)
    (folder / "data.bin").write_bytes(b"12345")
    manifest = {
        name: getattr(node, name)
        for name in ("kind", "key", "task", "seed", "axes", "config", "settings")
    }
    manifest["upstream"] = {name: needed.key for name, needed in node.needs.items()}
    manifest["sources"] = source_hashes(node.modules)
    manifest["provenance"] = {
        "versions": machine()["versions"],
        "seconds": 2.0,
        "started_at": "2026-01-01T00:00:00",
    }
    commit(layout, node.kind, node.key, folder, {**manifest, **changes})


def fill(layout: Layout, laid_out: Grid) -> None:
    for node in laid_out.nodes:
        store(layout, node)


def reasons_of(plan: Plan) -> dict[str, str]:
    return {step.node.label: step.reason for step in plan.steps if step.state == "changed"}


def test_a_changed_field_is_named_with_both_values(layout):
    fill(layout, grid())
    plan = plan_against(grid(wasp={"candidates": 9}), layout)
    found = reasons_of(plan)
    assert plan.count("missing") == 0
    assert found["goal1 s0 calibration wasp"] == "spec changed: wasp.candidates 8 -> 9"
    assert found["goal1 s1 wasp noisy=0.2"] == "spec changed: wasp.candidates 8 -> 9"
    assert all(" wasp" in label for label in found)


def test_what_only_reads_something_new_says_what(layout):
    fill(layout, grid())
    found = reasons_of(plan_against(grid(world_model={"updates": 21}), layout))
    assert found["goal1 s0 world_model"] == "spec changed: world_model.updates 20 -> 21"
    assert found["goal1 s0 policies"] == "upstream changed: world_model, latents"


def test_changed_code_is_named_by_module(layout):
    laid_out = grid()
    node = next(node for node in laid_out.nodes if node.label == "goal1 s0 wasp noisy=0.2")
    sources = source_hashes(node.modules)
    module = "wasp_cli.methods.wasp.search"
    assert module in sources
    earlier = Node(**{name: getattr(node, name) for name in Node.__slots__} | {"key": "a" * 20})
    store(layout, earlier, sources={**sources, module: "before", "wasp_cli.methods.wasp.gone": "x"})
    found = reasons_of(plan_against(laid_out, layout))
    assert found == {
        node.label: f"code changed: {module}, wasp_cli.methods.wasp.gone (no longer used)"
    }


def test_another_version_of_a_library_is_named(layout):
    laid_out = grid()
    node = laid_out.nodes[0]
    earlier = Node(**{name: getattr(node, name) for name in Node.__slots__} | {"key": "a" * 20})
    before = machine()["versions"] | {"torch": "1.13.1"}
    store(layout, earlier, provenance={"versions": before, "seconds": 1.0})
    (reason,) = reasons_of(plan_against(laid_out, layout)).values()
    assert reason.startswith("library changed: torch 1.13 -> ")


def test_the_nearest_of_several_versions_is_the_one_compared(layout):
    fill(layout, grid(wasp={"candidates": 9, "elites": 2, "alpha": 0.7}))
    fill(layout, grid(wasp={"candidates": 9}))
    fill(layout, grid(wasp={"candidates": 9, "elites": 2}))
    found = reasons_of(plan_against(grid(), layout))
    assert found["goal1 s0 wasp noisy=0.2"] == "spec changed: wasp.candidates 9 -> 8"


def test_what_a_published_result_took_was_not_measured_here(layout):
    here, elsewhere = grid().nodes[:2]
    store(layout, here)
    store(layout, elsewhere, provenance={"seconds": 2.0, FROM_PUBLISHED: True})
    assert measured(look_at(layout, {here.kind, elsewhere.kind})) == {here.sort: 2.0}
