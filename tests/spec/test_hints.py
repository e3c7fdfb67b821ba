"""Every mistake that one can put right by a word has that word as its hint."""

import pytest

from tests.spec.test_load import GOOD, only
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.spec.names import assistant_variants, training_stages
from wasp_cli.tasks.registry import TASKS


@pytest.mark.parametrize(
    ("addition", "hint"),
    [
        ("extend: base.yaml\n", "did you mean 'extends'?"),
        ("waps: {probe: 8}\n", "did you mean 'wasp'?"),
        ("world-model: {updates: 8}\n", "did you mean 'world_model'?"),
        ("wasp: {extends: base.yaml}\n", "'extends' belongs at the top level, outside every section"),
        ("policies: {rollout: 32}\n", "did you mean 'policies.reinforce.rollout', 'expert.rollout' or 'residual.rollout'?"),
        ("policies: {reinforce: {intractions: 32}}\n", "did you mean 'interactions'?"),
        ("wasp: {warmups: 3}\n", "did you mean 'world_model.warmup'?"),
        ("world_model: {mirror: yes}\n", "write true"),
        ("ida: {copilot: Expert}\n", "did you mean 'expert'?"),
        ("filter: {tau_c: auto}\n", "known: calibrated"),
        ("filter: {tau_c: '0.3'}\n", "without quotes: 0.3"),
        ("wasp: {rollouts: '3.5'}\n", None),
        ("expert: {hidden: 64}\n", "write [64]"),
        ("residual: {operators: {noisy: 0.3}}\n", "write [0.3]"),
        ("residual: {operators: {nosiy: [0.3]}}\n", "did you mean 'noisy'?"),
    ],
)  # fmt: skip
def test_keys_and_values_have_suggestions(addition, hint):
    assert only(GOOD + addition).hint == hint


@pytest.mark.parametrize(
    ("old", "new", "hint"),
    [
        ("{mild: 0.2}", "0.2", "with a name, for example {moderate: 0.2}"),
        ("name: good", "name: 7", 'in quotes: "7"'),
        ("seeds: [0]", "seeds: 0", "write [0]"),
        ("preset: smoke", "preset: Quik", "did you mean 'quick'?"),
    ],
)
def test_values_of_another_type_are_shown_with_the_right_one(old, new, hint):
    assert old in GOOD
    assert only(GOOD.replace(old, new)).hint == hint


@pytest.mark.parametrize(
    ("known", "text"),
    [
        (list(TASKS), "tasks: [{name}]"),
        (list(METHODS), "methods: [{name}]"),
        (list(OPERATORS), "operators: {{{name}: {{mild: 0.5}}}}"),
        (training_stages(), "stages: [{name}]"),
        (assistant_variants(), "variants: [{name}]"),
    ],
)
def test_every_registered_name_is_suggested_for_a_slip(known, text):
    for name in known:
        slip = name + "x" if len(name) < 6 else name[:2] + name[3:]
        key = text.partition(":")[0]
        lines = [line for line in GOOD.splitlines() if not line.startswith((key, "  "))]
        document = [*lines, *([] if key == "operators" else ["operators: {noisy: {mild: 0.2}}"]), text.format(name=slip)]
        spec = "\n".join(line for number, line in enumerate(document) if line != "operators:" or number == len(document) - 1)
        assert f"'{name}'" in (only(spec + "\n").hint or ""), slip


def test_control_characters_of_a_value_do_not_reach_the_terminal():
    shown = str(only(GOOD.replace("[goal1]", '["\\e[31mred\\a"]')))
    assert all(character.isprintable() or character == "\n" for character in shown)
