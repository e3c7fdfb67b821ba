import pytest

from tests.plan.test_grid import DOCUMENT, grid
from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.plan import Plan, make_plan
from wasp_cli.plan.selection import select

BOTH = {
    **DOCUMENT,
    "tasks": ["goal1", "race1"],
    "methods": ["human", "wasp"],
    "variants": ["full", "no-case2"],
}


def labels(laid_out: Grid, *texts: str) -> set[str]:
    keys = select(laid_out, texts) or frozenset()
    return {node.label for node in laid_out.nodes if node.key in keys}


def ran(plan: Plan) -> set[str]:
    return {node.label for node in plan.to_run()}


def test_conditions_narrow_and_selectors_widen():
    laid_out = grid(**BOTH)
    assert labels(
        laid_out, "task=race1,method=wasp,variant=no-case2,operator=noisy,severity=mild,seed=1"
    ) == {"race1 s1 wasp/no-case2 noisy=0.2"}
    either = labels(
        laid_out,
        "method=human,seed=0,operator=noisy,value=0.6",
        "task=goal1,method=human,seed=1,operator=limited-skill",
    )
    assert either == {
        "goal1 s0 human noisy=0.6",
        "race1 s0 human noisy=0.6",
        "goal1 s1 human limited-skill=0.25",
    }


def test_alternatives_and_exclusions():
    laid_out = grid(**BOTH)
    some = labels(
        laid_out, "task=goal1,seed=0,method=human|wasp,variant!=no-case2,severity!=moderate"
    )
    assert some == {
        f"goal1 s0 {method} noisy={value}" for method in ("human", "wasp") for value in (0.2, 0.6)
    }


def test_a_task_selects_what_the_spec_trains_there_too():
    assert "race1 s0 diagnostics" in labels(grid(**BOTH), "task=race1")
    assert "race1 s0 diagnostics" not in labels(grid(**BOTH), "task=race1,method=human")


def test_a_stage_selects_nodes_that_others_need():
    laid_out = grid(**BOTH)
    assert labels(laid_out, "stage=world_model,task=goal1") == {
        "goal1 s0 world_model",
        "goal1 s1 world_model",
    }
    plan = make_plan(
        laid_out, {}, {}, wanted=select(laid_out, ["stage=world_model,task=goal1,seed=0"])
    )
    assert ran(plan) == {"goal1 s0 expert", "goal1 s0 dataset", "goal1 s0 world_model"}
    assert {step.reason for step in plan.steps if not step.runs} == {"not selected"}


def test_what_nobody_needs_any_more_is_left_alone():
    laid_out = grid(stages=[], methods=["human"])
    cells = {node.key for _, node in laid_out.cells}
    plan = make_plan(laid_out, {"evaluate": cells}, {})
    assert plan.to_run() == []
    assert {step.reason for step in plan.steps if step.state == "unneeded"} == {
        "everything that needs it is computed"
    }
    one = next(iter(cells))
    again = make_plan(laid_out, {"evaluate": cells - {one}}, {})
    needed = next(node for node in laid_out.nodes if node.key == one)
    assert ran(again) == {
        needed.label,
        *(
            f"goal1 s{needed.seed} {kind}"
            for kind in ("expert", "dataset", "world_model", "latents", "policies")
        ),
    }


@pytest.mark.parametrize(
    "text", ["", "task", "task=", "=goal1", "task=goal1,", "task=goal1,,seed=0", "task=goal1|"]
)
def test_another_form_is_refused(text):
    with pytest.raises(UsageError, match="not of the form"):
        select(grid(), [text])


def test_names_that_are_not_there_get_a_suggestion():
    with pytest.raises(UnknownName, match="field to select by 'methd'") as error:
        select(grid(), ["methd=wasp"])
    assert error.value.hint == "did you mean 'method'?"
    with pytest.raises(UnknownName, match="method in this spec 'waps'") as error:
        select(grid(), ["method=waps"])
    assert error.value.hint == "did you mean 'wasp'?"
    with pytest.raises(UsageError, match="no node of the spec matches"):
        select(grid(), ["method=expert,operator=noisy"])
