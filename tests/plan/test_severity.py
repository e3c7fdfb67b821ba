"""Severities that are `auto` in a plan: which nodes there are, what moves their keys, and what a
spec may say.
"""

from typing import Any

import pytest

from wasp_cli.errors import WaspError
from wasp_cli.plan.grid import Grid, lay_out
from wasp_cli.plan.node import Node
from wasp_cli.plan.selection import select
from wasp_cli.spec.load import load
from wasp_cli.spec.model import spec_type, validate

DOCUMENT: dict[str, Any] = {
    "name": "small",
    "preset": "smoke",
    "tasks": ["goal1"],
    "methods": ["human", "wasp", "expert"],
    "operators": {"noisy": {"mild": 0.2, "moderate": "auto"}, "laggy": {"moderate": "auto"}},
    "seeds": [0],
    "stages": ["counterfactual"],
}


def grid(**changes: Any) -> Grid:
    return lay_out(validate({**DOCUMENT, **changes}))


def severities(laid_out: Grid) -> dict[str, Node]:
    """The nodes of the stage by operator."""
    return {node.axes["operator"]: node for node in laid_out.nodes if node.kind == "severity"}


def keys(laid_out: Grid) -> dict[str, str]:
    return {operator: node.key for operator, node in severities(laid_out).items()}


def test_each_operator_has_a_node_which_its_cells_and_their_branches_read():
    laid_out = grid()
    nodes = severities(laid_out)
    assert set(nodes) == {"none", "noisy", "laggy"}
    for operator in ("noisy", "laggy"):
        assert nodes[operator].needs["references"] is nodes["none"]
    for cell, node in (*laid_out.cells, *laid_out.branched):
        if cell.value == "auto":
            assert node.needs["severity"] is nodes[cell.operator]
            assert node.axes["value"] == "auto"
        else:
            assert "severity" not in node.needs


def test_every_training_and_task_chooses_for_itself():
    laid_out = grid(seeds=[0, 1], tasks=["goal1", "race1"])
    places = {
        (node.task, node.seed, node.axes["operator"])
        for node in laid_out.nodes
        if node.kind == "severity"
    }
    assert len(places) == 2 * 2 * 3
    shared = grid(seeds=[0, 1], training_seed=5)
    assert {node.seed for node in shared.nodes if node.kind == "severity"} == {5}


def test_numbers_beside_it_keep_their_keys():
    with_auto = grid()
    numbers = grid(operators={"noisy": {"mild": 0.2}, "laggy": {"severe": 0.85}})
    before = {node.key for node in numbers.nodes if "laggy" not in node.label}
    assert before <= {node.key for node in with_auto.nodes}
    assert not severities(numbers)


def test_a_severity_is_chosen_once_whatever_is_evaluated():
    before = keys(grid())
    assert keys(grid(episodes=50, side_by_side=1, methods=["ida"])) == before
    assert keys(grid(operators={"noisy": {"other": "auto"}}))["noisy"] == before["noisy"]
    assert not set(keys(grid(severity={"kept": 0.5})).values()) & set(before.values())


def test_the_share_of_one_task_may_be_another():
    both = {"tasks": ["goal1", "race1"]}
    before = grid(**both)
    after = grid(**both, by_task={"race1": {"severity": {"kept": 0.5}}})
    known = {node.key for node in before.nodes}
    assert {node.task for node in after.nodes if node.key not in known} == {"race1"}


def test_a_limited_skill_tries_the_earlier_checkpoints():
    laid_out = grid(operators={"limited-skill": {"moderate": "auto"}})
    ladder = severities(laid_out)["limited-skill"].axes["ladder"]
    checkpoints = validate(DOCUMENT).stage("expert").model_dump()["checkpoints"]
    assert ladder["tried"] == sorted(checkpoints[:-1], reverse=True)


def test_the_record_of_a_spec_plans_the_same_nodes():
    written = validate(DOCUMENT)
    record = spec_type().model_validate_json(written.model_dump_json(), strict=True)
    assert [node.key for node in lay_out(record).nodes] == [
        node.key for node in lay_out(written).nodes
    ]


def test_cells_and_what_chooses_for_them_can_be_selected():
    laid_out = grid()
    chosen = select(laid_out, ["value=auto,operator=laggy,method=human"])
    (cell,) = (cell for cell, node in laid_out.cells if node.key in (chosen or ()))
    assert (cell.operator, cell.value, cell.method) == ("laggy", "auto", "human")
    searching = select(laid_out, ["stage=severity,operator=noisy"])
    assert searching == {severities(laid_out)["noisy"].key}


MISTAKES = {
    "noisy: {mild: auto, moderate: auto}": "'mild' of 'noisy' is auto too",
    "noisy: {moderate: automatic}": "should be a number or 'auto', not 'automatic'",
    "noisy: {moderate: 1.5}": "should lie between 0 and 1",
    "person: {p1: auto}": "for the severity of a simulated operator",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_mistakes_are_shown_at_their_line(line, tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text(
        "name: small\npreset: smoke\ntasks: [goal1]\nmethods: [human, wasp]\n"
        f"operators:\n  {line}\nseeds: [0]\nepisodes: 2\n"
    )
    with pytest.raises(WaspError) as refused:
        load(path)
    assert "spec.yaml:6:" in str(refused.value)
    assert MISTAKES[line] in str(refused.value)


def test_it_is_no_stage_that_a_spec_lists(tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text(
        "name: small\ntasks: [goal1]\nmethods: [expert]\nseeds: [0]\nstages: [severity]\n"
    )
    with pytest.raises(WaspError) as refused:
        load(path)
    assert "spec.yaml:5:" in str(refused.value)
    assert "'severity' runs for an operator" in str(refused.value)
