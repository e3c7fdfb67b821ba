from typing import Any

import pytest

from wasp_cli.errors import WaspError
from wasp_cli.plan.grid import Grid, lay_out, stage_class
from wasp_cli.plan.node import Node
from wasp_cli.spec.model import Spec, validate

DOCUMENT: dict[str, Any] = {
    "name": "small",
    "preset": "smoke",
    "tasks": ["goal1"],
    "methods": ["human", "ida", "wasp", "expert"],
    "operators": {"noisy": {"mild": 0.2, "severe": 0.6}, "limited-skill": {"moderate": 0.25}},
    "seeds": [0, 1],
}


def spec(**changes: Any) -> Spec:
    return validate({**DOCUMENT, **changes})


def grid(**changes: Any) -> Grid:
    return lay_out(spec(**changes))


def keys(laid_out: Grid) -> set[str]:
    return {node.key for node in laid_out.nodes}


def by_label(laid_out: Grid) -> dict[str, Node]:
    return {node.label: node for node in laid_out.nodes}


def changed(**changes: Any) -> set[str]:
    """Labels of the nodes whose key a change moves."""
    before, after = by_label(grid()), by_label(grid(**changes))
    return {
        label for label in before.keys() & after.keys() if before[label].key != after[label].key
    }


def test_table_1_has_the_size_of_the_paper():
    severities = {"mild": 0.2, "moderate": 0.4, "severe": 0.6}
    operators = {
        "noisy": severities,
        "laggy": severities,
        "reaction-time": severities,
        "limited-skill": {"a": 0.1, "b": 0.25, "c": 0.5},
    }
    methods = ["human", "ida", "diffusion", "saferl", "filter", "wasp", "expert"]
    table = grid(
        tasks=["race1", "formula1", "goal1"], methods=methods, operators=operators, seeds=[0, 1, 2]
    )
    assert table.points == 3 * 7 * 4 * 3 * 3
    # the paper's five methods, the filter, and the expert once for all operators
    assert len(table.cells) == 3 * 6 * 12 * 3 + 3 * 3
    assert len({node.key for _, node in table.cells}) == len(table.cells)


def test_a_stage_that_needs_an_unknown_one_is_named(monkeypatch):
    monkeypatch.setattr(stage_class("latents"), "needs", ("world_modl",))
    with pytest.raises(
        WaspError, match="the stage 'latents' needs an unknown stage 'world_modl'"
    ) as caught:
        grid()
    assert caught.value.hint == "did you mean 'world_model'?"


def test_what_a_method_reads_may_depend_on_its_settings():
    def needs(**settings: object) -> dict[str, set[str]]:
        nodes = {node.label: node for node in grid(methods=["ida"], **settings).nodes}
        return {
            kind: set(nodes[f"goal1 s0 {kind}"].needs)
            for kind in ("calibration ida", "ida noisy=0.2")
        }

    assert all("denoiser" not in kinds for kinds in needs().values())
    assert all("denoiser" in kinds for kinds in needs(ida={"copilot": "diffusion"}).values())


def test_names_and_orders_enter_no_key():
    shuffled = {
        "name": "other",
        "methods": ["wasp", "expert", "human", "ida"],
        "operators": {"limited-skill": {"x": 0.25}, "noisy": {"strong": 0.6, "weak": 0.2}},
        "seeds": [1, 0],
    }
    assert keys(grid(**shuffled)) == keys(grid())


def test_ablations_share_training_and_the_calibration_of_the_whole():
    ablation = grid(methods=["wasp"], variants=["full", "no-case2"])
    assert keys(grid(methods=["wasp"])) < keys(ablation)
    assert sum(node.kind == "calibration" for node in ablation.nodes) == 2
    assert {cell.variant for cell, _ in ablation.cells} == {"full", "no-case2"}
    assert {
        node.axes["method_config"]["variant"] for node in ablation.nodes if node.kind == "evaluate"
    } == {"full", "no-case2"}


def test_the_world_model_moves_everything_after_it():
    moved = changed(world_model={"updates": 21})
    still = set(by_label(grid())) - moved
    assert {label.split(maxsplit=2)[2] for label in still} == {"expert", "dataset"}


def test_what_a_task_has_of_its_own_moves_that_task_alone():
    own = {"formula1": {"world_model": {"updates": 21}, "wasp": {"candidates": 9}}}
    tasks = ["goal1", "formula1"]
    before, after = by_label(grid(tasks=tasks)), by_label(grid(tasks=tasks, by_task=own))
    moved = {label for label in before if before[label].key != after[label].key}
    assert {label.partition(" ")[0] for label in moved} == {"formula1"}
    # It is what the section would give, were it the only task.
    alone = by_label(grid(tasks=["formula1"], **own["formula1"]))
    assert {label: node.key for label, node in alone.items()} == {
        label: node.key for label, node in after.items() if label.startswith("formula1")
    }
    assert after["formula1 s0 wasp noisy=0.2"].axes["method_config"]["candidates"] == 9
    assert after["goal1 s0 wasp noisy=0.2"].axes["method_config"]["candidates"] == 8
    same = {"formula1": {"world_model": {"updates": 20}}, "race1": {"wasp": {"candidates": 9}}}
    # and a task that does not run is no mistake
    assert keys(grid(tasks=tasks, by_task=same)) == keys(grid(tasks=tasks))


def test_shared_settings_move_the_stages_that_named_them():
    moved = {label.split(maxsplit=2)[2] for label in changed(returns={"gamma_c": 0.9})}
    assert "critics" in moved
    assert not {"expert", "dataset", "world_model", "policies"} & moved
    assert len(changed(action_repeat=2)) == len(grid().nodes)


def test_one_training_seed_serves_all_evaluation_seeds():
    shared = grid(training_seed=5)
    assert {node.seed for node in shared.nodes if node.kind != "evaluate"} == {5}
    assert {node.seed for node in shared.nodes if node.kind == "evaluate"} == {0, 1}
    # The same chain as that of evaluation seed 5.
    assert keys(grid(training_seed=5, seeds=[5])) == keys(grid(seeds=[5]))


def test_an_evaluation_reads_what_its_method_needs():
    nodes = by_label(grid())
    assert set(nodes["goal1 s0 human noisy=0.2"].needs) == {"world_model", "policies"}
    assert set(nodes["goal1 s0 wasp noisy=0.2"].needs) == {
        "world_model",
        "policies",
        "critics",
        "calibration",
    }
    assert set(nodes["goal1 s0 calibration ida"].needs) == {
        "heldout",
        "world_model",
        "policies",
        "ida_q",
    }
    assert nodes["goal1 s0 wasp noisy=0.2"].needs["calibration"].axes == {
        "method": "wasp",
        "method_config": spec().method("wasp").model_dump(mode="json"),
    }


def test_named_stages_are_trained_once_for_each_task_and_chain():
    laid_out = grid(
        tasks=["goal1", "race1"],
        methods=[],
        stages=["heldout", "world_model"],
        operators={},
        seeds=[0, 1],
    )
    assert (laid_out.cells, laid_out.points) == ((), 0)
    kinds = ["expert", "dataset", "world_model", "latents", "policies", "heldout"]
    assert sorted(node.label for node in laid_out.nodes) == sorted(
        f"{t} s{s} {k}" for t in ("goal1", "race1") for s in (0, 1) for k in kinds
    )
    shared = grid(methods=[], stages=["critics"], operators={}, seeds=[0, 1, 2], training_seed=1)
    assert {node.seed for node in shared.nodes} == {1}
    assert keys(shared) < keys(grid(seeds=[1]))
