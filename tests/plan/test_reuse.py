"""Recipes, and which of several published results stands in the place of a node."""

import random
from pathlib import Path

from tests.plan.test_grid import by_label, spec
from tests.plan.test_grid import grid as own_grid
from wasp_cli.plan import grid, keys
from wasp_cli.plan.grid import Grid, lay_out
from wasp_cli.plan.node import Node
from wasp_cli.plan.reuse import choose
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import Offer

MODEL, LATENTS, SKILLS = "goal1 s0 world_model", "goal1 s0 latents", "goal1 s0 policies"
HELDOUT, CRITICS = "goal1 s0 heldout", "goal1 s0 critics"
NOWHERE = Layout(Path("nowhere"))


def recipes(laid_out: Grid) -> dict[str, str]:
    return {node.label: node.recipe for node in laid_out.nodes}


def offer(
    own: Grid, label: str, key: str, behind: dict[str, str] | None = None, at: str = "2026-01-01"
) -> Offer:
    """A published result of a node, with all that it needs as today's code would have it, but
    for `behind` (by label).
    """
    node = by_label(own)[label]
    today: dict[str, str] = {}

    def collect(node: Node) -> None:
        for needed in node.needs.values():
            today[needed.recipe] = (behind or {}).get(needed.label, needed.key)
            collect(needed)

    collect(node)
    return Offer(NOWHERE, node.kind, key, node.recipe, today, {"provenance": {"started_at": at}})


def version(number: int) -> dict[str, str]:
    """Keys of one version of all that is trained behind the critics, by label."""
    return {
        label: f"{number}{letter}" * 10
        for label, letter in zip((MODEL, LATENTS, SKILLS, HELDOUT, CRITICS), "abcde", strict=True)
    }


def chosen(own: Grid, offered: list[Offer]) -> dict[str, str]:
    """The key of what is reused, by label, whatever the order of what is offered."""
    labels = {node.recipe: node.label for node in own.nodes}
    found = {labels[recipe]: each.key for recipe, each in choose(own, offered).items()}
    shuffled = random.Random(0).sample(offered, len(offered))
    assert {labels[recipe]: each.key for recipe, each in choose(own, shuffled).items()} == found
    return found


def test_a_recipe_is_the_configuration_without_the_code(monkeypatch):
    before, plain = recipes(own_grid()), own_grid()
    monkeypatch.setattr(grid, "closure_hash", lambda roots, without: "other code")
    monkeypatch.setattr(keys, "libraries", lambda: {"torch": "other"})
    after = own_grid()
    assert recipes(after) == before
    assert not {node.key for node in after.nodes} & {node.key for node in plain.nodes}
    assert len(set(before.values())) == len(before) == len(plain.nodes)


def test_what_is_computed_from_a_reused_node_has_another_key():
    own = own_grid()
    before = by_label(own)
    critics = before["goal1 s0 critics"]
    after = by_label(lay_out(spec(), {critics.recipe: "a" * 20}))
    assert after["goal1 s0 critics"].key == "a" * 20
    moved = {label for label in before if before[label].key != after[label].key}
    assert moved == {label for label, node in before.items() if critics in (node, *upstream(node))}
    assert after["goal1 s0 wasp noisy=0.2"].needs["critics"].key == "a" * 20


def upstream(node: Node) -> list[Node]:
    return [each for needed in node.needs.values() for each in (needed, *upstream(needed))]


def test_of_several_todays_code_counts_first_and_then_the_newest():
    own = own_grid()
    label = "goal1 s0 human noisy=0.2"
    older, newer = (
        offer(own, label, "a" * 20, at="2026-01-01"),
        offer(own, label, "b" * 20, at="2026-02-01"),
    )
    today = offer(own, label, by_label(own)[label].key, at="2025-01-01")
    assert chosen(own, [older, newer]) == {label: newer.key}
    assert chosen(own, [older, newer, today]) == {label: today.key}


def test_what_goes_with_what_else_is_reused_counts_before_what_is_newer():
    own = own_grid()
    first, second = version(1), version(2)
    offered = [offer(own, MODEL, first[MODEL], at="2026-03-01")]
    for behind, at in ((first, "2026-01-01"), (second, "2026-02-01")):
        offered += [
            offer(own, label, behind[label], behind, at)
            for label in (LATENTS, SKILLS, HELDOUT, CRITICS)
        ]
    assert chosen(own, offered) == first


def test_what_goes_with_nothing_here_is_left_alone():
    own = own_grid()
    cell, behind = "goal1 s0 wasp noisy=0.2", version(1)
    foreign = offer(own, CRITICS, behind[CRITICS], behind)
    assert chosen(own, [foreign]) == {}
    # The rows of a cell are read by nothing, so that they need not go with anything.
    assert chosen(own, [foreign, offer(own, cell, "f" * 20, behind)]) == {cell: "f" * 20}
    # Half of what it goes with is not enough: the skills of today would be others than those behind
    # it.
    model = offer(own, MODEL, behind[MODEL])
    assert chosen(own, [foreign, model]) == {MODEL: model.key}
    assert (
        chosen(
            own,
            [
                foreign,
                model,
                *(offer(own, label, behind[label], behind) for label in (LATENTS, SKILLS, HELDOUT)),
            ],
        )
        == behind
    )


def test_what_lies_behind_everything_that_is_read_need_not_be_there():
    own = own_grid(methods=["wasp"], stages=[])
    behind = {"goal1 s0 dataset": "1f" * 10, **version(1)}
    offered = [offer(own, label, behind[label], behind) for label in version(1)]
    # Calibrating reads nothing but these: the dataset of today does not meet the one behind them.
    assert chosen(own, offered) == version(1)
    # Judging the world model does read it.
    judged = own_grid(methods=["wasp"])
    assert (
        chosen(judged, [offer(judged, label, behind[label], behind) for label in version(1)]) == {}
    )


def test_what_is_needed_for_reused_results_alone_meets_nothing():
    """Remembered latents are large, and not published: nobody computes them where all that is
    learned from them is reused.
    """
    own = own_grid(methods=["wasp"], stages=[])
    behind = {"goal1 s0 dataset": "1f" * 10, **version(1)}
    published = {label: key for label, key in version(1).items() if label != LATENTS}
    assert (
        chosen(own, [offer(own, label, key, behind) for label, key in published.items()])
        == published
    )


def test_heldout_rows_may_be_recorded_again():
    """They are too large to be published. What was judged on the former ones goes on being
    used; an older world model does not.
    """
    own = own_grid(methods=["wasp"], stages=[])
    behind = {"goal1 s0 dataset": "1f" * 10, **version(1)}
    published = {label: key for label, key in version(1).items() if label not in (LATENTS, HELDOUT)}
    offered = [offer(own, label, key, behind) for label, key in published.items()]
    assert chosen(own, offered) == published
    # Critics of another world model do not, and those of today would be trained on latents of
    # today.
    foreign = offer(own, CRITICS, published[CRITICS], {**behind, MODEL: "2a" * 10})
    assert chosen(own, [*(each for each in offered if each.kind != "critics"), foreign]) == {}
