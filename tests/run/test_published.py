"""Published results over fake stages: what is used instead of computed, and under whose key."""

import shutil

from tests.plan.test_plan import text_of
from tests.run.harness import data_of
from tests.run.layered import (
    COMMON,
    MORE,
    SPECIFIC,
    kinds,
    node_of,
    plan,
    published_manifest,
    rewrite,
    run,
)
from wasp_cli.plan import reasons
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.plan.source import closure
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout


def test_a_fresh_folder_computes_nothing_that_is_published(
    here, computed, fakes, small_spec, capsys
):
    before = plan(small_spec, here)
    done = run(small_spec, here)
    assert not fakes.executions()
    assert done.plan.as_json() == before.as_json()
    # What is asked for is brought in, and nothing that only stands behind it.
    taken = {step.node for step in before.steps if step.state == "published"}
    assert (
        {node.key for node in taken}
        == before.grid.targets
        == {path.parent.name for path in here.glob("store/*/*/_manifest.json")}
    )
    assert {step.reason for step in before.steps if step.node in taken} == {
        "published with this code"
    }
    assert {step.reason for step in before.steps if step.node not in taken} == {
        "everything that needs it is computed"
    }
    assert data_of(here).items() <= data_of(computed / "elsewhere").items()
    assert f"0 computed, 0 computed before, {len(taken)} published in" in capsys.readouterr().err
    assert plan(small_spec, here).count("cached") == len(taken)
    assert f"nothing to compute: a run copies {len(taken)} published results" in text_of(before)
    # The code is the same, so the keys are those that they would have been anyway.
    assert {node.key for node in lay_out(load(small_spec).spec).nodes} == {
        step.node.key for step in before.steps
    }


def test_the_spec_says_what_is_reused_and_the_option_wins(here, fakes, small_spec):
    layout = Layout(here)
    assert not lay_out_over(load(small_spec).spec, layout).reused
    assert lay_out_over(load(small_spec, ("reuse=published",)).spec, layout).reused
    assert not lay_out_over(load(small_spec, ("reuse=published",)).spec, layout, "none").reused
    run_spec(load(small_spec, ("reuse=published",)), here, RunOptions(jobs=0))
    assert not fakes.executions()


def test_when_the_code_has_moved_on_the_plan_names_it(here, fakes, small_spec, moved, capsys):
    rewrite(
        published_manifest(here, "goal1 s0 ida noisy=0.2"),
        lambda manifest: manifest["provenance"].update(git={"sha": "abcdef0123"}),
    )
    moved(SPECIFIC)
    found = {step.node.label: step for step in plan(small_spec, here).steps}
    assert (
        found["goal1 s0 ida noisy=0.2"].reason
        == "published by another version of this code (git abcdef0)"
    )
    assert found["goal1 s0 human noisy=0.2"].reason == "published with this code"
    run(small_spec, here)
    assert not fakes.executions()
    assert "published by another version of this code (git abcdef0)" in capsys.readouterr().err
    again = plan(small_spec, here.parent / "again", choice=str(here / "published"))
    assert "--all names what has changed since" in text_of(again)
    assert SPECIFIC not in text_of(again)
    assert f"(git abcdef0); changed since: {SPECIFIC}" in text_of(again, every=True)
    assert found["goal1 s0 ida noisy=0.2"].node.key not in {
        node.key for node in lay_out(load(small_spec).spec).nodes
    }


def test_what_was_computed_from_other_code_is_other_code(here, small_spec, moved):
    module = "wasp_cli.methods.wasp.search"
    moved(module)
    calibration, *_ = [
        step
        for step in plan(small_spec, here).steps
        if step.node.label == "goal1 s0 calibration wasp"
    ]
    assert module in closure(calibration.node.modules)
    rewrite(
        published_manifest(here, "goal1 s0 wasp noisy=0.2"),
        lambda manifest: manifest.update(
            sources=reasons.source_hashes(
                node_of(plan(small_spec, here), "goal1 s0 wasp noisy=0.2").modules
            )
        ),
    )
    found = {step.node.label: step.reason for step in plan(small_spec, here).steps}
    assert found["goal1 s0 wasp noisy=0.2"].startswith("published by another version of this code")
    assert "; its inputs were computed by another version" in text_of(
        plan(small_spec, here), every=True
    )


def test_what_is_computed_from_published_results_has_keys_that_say_so(
    here, fakes, small_spec, moved
):
    moved(COMMON)
    before = plan(small_spec, here, MORE)
    done = run(small_spec, here, MORE)
    new = [step.node for step in before.steps if step.runs]
    assert all("noisy=0.6" in node.label for node in new)
    assert kinds(fakes.executions()) == {"evaluate": len(new)} == {"evaluate": 2 * 3}
    without = {node.label: node.key for node in lay_out(load(small_spec, MORE).spec).nodes}
    for node in new:
        assert node.key != without[node.label]
        manifest = read_manifest(done.layout, node.kind, node.key)
        assert manifest["upstream"] == {name: needed.key for name, needed in node.needs.items()}
        assert all(needed.key in before.grid.reused for needed in node.needs.values())
    # Under the code of today, nothing of it counts.
    assert plan(small_spec, here, MORE, "none").count("cached") == 0


def test_results_of_two_codes_are_never_mixed_behind_one_node(here, fakes, small_spec, moved):
    shutil.rmtree(here / "published/store/world_model")
    moved(COMMON)
    # The world model would be another one: what was trained on the states of the first one does not
    # go with it.
    done = run(small_spec, here, MORE)
    ran = kinds(fakes.executions())
    assert ran["world_model"] == ran["critics"] == ran["policies"] == 2
    published = set(done.plan.grid.reused)
    for step in done.plan.steps:
        if step.runs:
            assert {
                needed.kind for needed in step.node.needs.values() if needed.key in published
            } <= {"expert", "dataset", "heldout"}
    # The cells that are published are still those.
    assert ran["evaluate"] == 2 * 3
    assert (
        done.plan.count("published", "evaluate")
        == len({node.key for _, node in done.plan.grid.cells}) - 2 * 3
    )


JUDGED = ("stages=[counterfactual]",)


def slimmed(manifest: dict[str, object]) -> None:
    manifest["slim"] = {
        "_steps.pq": {"left_out": "steps of all episodes but the first", "sha256": "0" * 64}
    }


def test_a_cell_without_its_steps_stands_for_its_rows_and_never_for_what_reads_steps(
    here, fakes, small_spec
):
    """Branches of interventions begin in the steps of a cell: where they are left out, the cell
    is computed again for them, whole.
    """
    rewrite(published_manifest(here, "goal1 s0 ida noisy=0.2"), slimmed)
    run(small_spec, here)
    assert not fakes.executions()
    fresh = here.parent / "other"
    shutil.copytree(here / "published", fresh / "published")
    run(small_spec, fresh, JUDGED)
    assert kinds(fakes.executions())["evaluate"] == 1


def test_a_cell_without_its_steps_in_the_store_is_computed_again_when_they_are_needed(
    here, fakes, small_spec
):
    rewrite(published_manifest(here, "goal1 s0 ida noisy=0.2"), slimmed)
    run(small_spec, here)
    assert (
        len([node for node in plan(small_spec, here, JUDGED).to_run() if node.kind == "evaluate"])
        == 1
    )
    run(small_spec, here, JUDGED)
    assert kinds(fakes.executions())["evaluate"] == 1
    after = plan(small_spec, here, JUDGED)
    assert not after.to_run()
