"""Operating points in a plan: which nodes there are, what moves their keys, what a spec may say."""

from typing import Any

import pytest

from wasp_cli.errors import WaspError
from wasp_cli.plan.grid import Grid, lay_out
from wasp_cli.plan.node import Node
from wasp_cli.spec.load import load
from wasp_cli.spec.model import Spec, spec_type, validate
from wasp_cli.spec.presets import PRESETS
from wasp_cli.tasks.registry import TASKS

DOCUMENT: dict[str, Any] = {
    "name": "small",
    "preset": "smoke",
    "tasks": ["goal1"],
    "methods": ["human", "ida", "diffusion", "wasp", "expert", "planner"],
    "operators": {"noisy": {"mild": 0.2}},
    "seeds": [0],
    "training_seed": 0,
    "operating_points": "chosen",
}


def spec(**changes: Any) -> Spec:
    return validate({**DOCUMENT, **changes})


def grid(**changes: Any) -> Grid:
    return lay_out(spec(**changes))


def operating(laid_out: Grid) -> dict[str, Node]:
    """The nodes of the stage by method."""
    return {node.axes["method"]: node for node in laid_out.nodes if node.kind == "operating"}


def keys(nodes: dict[str, Node]) -> dict[str, str]:
    return {method: node.key for method, node in nodes.items()}


def test_each_assistant_has_a_node_and_all_read_the_operators_alone():
    nodes = operating(grid())
    assert set(nodes) == {"human", "ida", "diffusion", "wasp"}
    for method, node in nodes.items():
        if method != "human":
            assert node.needs["alone"] is nodes["human"]
    for cell, node in grid().cells:
        if cell.method in ("human", "expert", "planner"):
            assert "operating" not in node.needs
        else:
            assert node.needs["operating"].axes["method"] == cell.method


def test_given_plans_what_a_spec_on_our_tasks_planned_without_the_field():
    without = {name: value for name, value in DOCUMENT.items() if name != "operating_points"}
    default, given = lay_out(validate(without)), grid(operating_points="given")
    assert [node.key for node in default.nodes] == [node.key for node in given.nodes]
    assert not operating(default)


def test_points_are_chosen_on_tasks_of_ones_own_unless_the_spec_says_otherwise():
    for task in TASKS.own:
        assert not spec(operating_points="auto").chooses_point(task, "wasp")
        assert spec(operating_points="chosen").chooses_point(task, "wasp")
    assert spec(operating_points="auto").chooses_point("mine:Env-v0", "wasp")
    assert not spec(operating_points="given").chooses_point("mine:Env-v0", "wasp")
    assert not spec(operating_points="auto").chooses_point("mine:Env-v0", "human")


def test_a_larger_evaluation_chooses_no_other_point():
    before = keys(operating(grid()))
    larger = grid(
        seeds=[0, 1, 2],
        episodes=50,
        operators={"noisy": {"mild": 0.2}, "laggy": {"severe": 0.85}},
        side_by_side=1,
    )
    assert keys(operating(larger)) == before


def test_values_of_a_knob_are_in_the_key_of_its_assistant_alone():
    before = keys(operating(grid()))
    after = keys(operating(grid(operating={"values": {"diffusion": [0.3, 0.6]}})))
    assert {method for method in before if before[method] != after[method]} == {"diffusion"}
    more = keys(operating(grid(operating={"episodes": 3})))
    assert not set(more.values()) & set(before.values())


def test_an_assistant_whose_knob_is_written_keeps_it():
    assert set(operating(grid(diffusion={"ratio": 0.4}))) == {"human", "ida", "wasp"}
    assert set(operating(grid(diffusion={"last_noise": True}))) == {
        "human",
        "ida",
        "diffusion",
        "wasp",
    }
    both = grid(tasks=["goal1", "race1"], by_task={"race1": {"wasp": {"tau_r": 0.3}}})
    tasks = {
        node.task
        for node in both.nodes
        if node.kind == "operating" and node.axes["method"] == "wasp"
    }
    assert tasks == {"goal1"}
    assert set(operating(grid(by_hand={"goal1": ["ida"]}, diffusion={"ratio": 0.4}))) == {
        "human",
        "diffusion",
        "wasp",
    }


def test_the_record_of_a_spec_plans_the_same_nodes():
    written = spec(diffusion={"ratio": 0.4})
    record = spec_type().model_validate_json(written.model_dump_json(), strict=True)
    assert [node.key for node in lay_out(record).nodes] == [
        node.key for node in lay_out(written).nodes
    ]


def test_ablations_share_the_point_of_what_they_ablate():
    laid_out = grid(methods=["human", "wasp"], variants=["full", "safety-only", "no-rollout"])
    found = {cell.variant: node.needs["operating"] for cell, node in laid_out.cells[1:]}
    assert found["safety-only"] is found["full"]
    assert found["no-rollout"] is not found["full"]  # its thresholds have another unit


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_takes_at_most_half_of_an_evaluation_with_two_operators_and_one_seed(preset):
    sized = spec(preset=preset)
    held_out = sized.stage("operating").model_dump()["episodes"]
    assert 1 <= held_out <= sized.episodes * 2 // 2


MISTAKES = {
    "operating_points: maybe": (8, "operating_points"),
    "operating: {episodes: 0}": (8, "greater than or equal to 1"),
    "operating: {epsiodes: 5}": (8, "epsiodes"),
    "operating: {values: {wasp: []}}": (8, "should not be empty"),
    "operating: {values: {human: [1]}}": (8, "unknown assistant with a knob 'human'"),
    "operating: {values: {wasp: [1, 1]}}": (8, "listed twice"),
    "by_task: {goal1: {operating: {values: {human: [1]}}}}": (8, "assistant with a knob 'human'"),
    "operating: {operators: {noisy: [7]}}": (8, "should lie between"),
}


@pytest.mark.parametrize("line", MISTAKES)
def test_mistakes_are_shown_at_their_line(line, tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text(
        "name: small\npreset: smoke\ntasks: [goal1]\nmethods: [human, wasp]\n"
        f"operators: {{noisy: {{mild: 0.2}}}}\nseeds: [0]\nepisodes: 2\n{line}\n"
    )
    with pytest.raises(WaspError) as refused:
        load(path)
    number, words = MISTAKES[line]
    assert f"spec.yaml:{number}:" in str(refused.value)
    assert words in str(refused.value)
