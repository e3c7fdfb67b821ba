"""The nodes of counterfactual branches: which there are, what moves their keys, how they are
selected.
"""

from typing import Any

from tests.plan.test_grid import by_label, grid
from tests.plan.test_select import labels, ran
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.plan import make_plan
from wasp_cli.plan.selection import select
from wasp_cli.plan.source import closure


def judged(**changes: Any) -> Grid:
    return grid(**{"stages": ["diagnostics", "counterfactual"], **changes})


def branch_labels(laid_out: Grid) -> list[str]:
    return [node.label for node in laid_out.nodes if node.kind == "counterfactual"]


def moved(before: Grid, after: Grid) -> set[str]:
    old, new = by_label(before), by_label(after)
    return {label for label in old.keys() & new.keys() if old[label].key != new[label].key}


def test_every_cell_whose_method_may_intervene_is_branched_once():
    laid_out = judged(methods=list(METHODS), variants=["full", "no-case2"], seeds=[3])
    assisted = [name for name in METHODS if METHODS[name].intervenes] + [
        "wasp/no-case2",
        "printed/no-case2",
    ]
    operators = ("noisy=0.2", "noisy=0.6", "limited-skill=0.25")
    assert sorted(branch_labels(laid_out)) == sorted(
        f"goal1 s3 counterfactual {who} {operator}" for who in assisted for operator in operators
    )
    assert [cell for cell, _ in laid_out.branched] == [
        cell for cell, _ in laid_out.cells if METHODS[cell.method].intervenes
    ]
    assert all(cell.operator != UNIMPAIRED for cell, _ in laid_out.branched)
    assert {node.key for _, node in laid_out.branched} <= laid_out.targets


def test_a_node_reads_the_cell_that_it_is_about_and_the_chain_of_its_models():
    laid_out = judged(training_seed=9, seeds=[0, 1])
    nodes = by_label(laid_out)
    node = nodes["goal1 s1 counterfactual ida noisy=0.2"]
    assert {name: needed.label for name, needed in node.needs.items()} == {
        "world_model": "goal1 s9 world_model",
        "policies": "goal1 s9 policies",
        "heldout": "goal1 s9 heldout",
        "evaluate": "goal1 s1 ida noisy=0.2",
    }
    assert node.seed == 1
    assert node.axes == nodes["goal1 s1 ida noisy=0.2"].axes
    assert "wasp_cli.operators.noisy" in node.modules
    assert node.key not in {part_node.key for _, part_node in laid_out.parts}


def test_its_own_section_moves_its_keys_alone_and_the_cell_moves_its_own():
    branches = set(branch_labels(judged()))
    assert len(branches) == 2 * 2 * 3
    for change in ({"window": 9}, {"stride": 3}, {"most": 7}, {"tau_R_fraction": 0.2}):
        assert moved(judged(), judged(counterfactual=change)) == branches
    of_ida = {label for label in branches if " ida " in label}
    assert moved(judged(), judged(ida={"quantile": 0.123})) & branches == of_ida


def test_the_code_of_assistants_is_in_the_key_through_the_cell_alone():
    node = by_label(judged())["goal1 s0 counterfactual wasp noisy=0.2"]
    own = closure(node.modules)
    assert "wasp_cli.learning.counterfactual" in own
    assert not {name for name in own if name.startswith("wasp_cli.methods.wasp")}


def test_selectors_name_the_branches_of_cells():
    laid_out = judged()
    assert labels(laid_out, "method=wasp,operator=noisy,severity=mild,seed=0") == {
        "goal1 s0 wasp noisy=0.2",
        "goal1 s0 counterfactual wasp noisy=0.2",
    }
    alone = labels(laid_out, "stage=counterfactual,value=0.6,seed=1")
    assert alone == {f"goal1 s1 counterfactual {method} noisy=0.6" for method in ("ida", "wasp")}
    plan = make_plan(
        laid_out,
        {},
        {},
        wanted=select(laid_out, ["stage=counterfactual,method=ida,value=0.6,seed=1"]),
    )
    kinds = (
        "expert",
        "dataset",
        "world_model",
        "latents",
        "policies",
        "heldout",
        "ida_q",
        "calibration ida",
        "ida noisy=0.6",
    )
    assert ran(plan) == {f"goal1 s1 {kind}" for kind in (*kinds, "counterfactual ida noisy=0.6")}
