"""What is proposed in the place of a wrong value is accepted, in a file and as `--set`."""

import re
import shlex
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from tests.spec.good import GOOD
from wasp_cli.errors import WaspError
from wasp_cli.spec.hints import settings as setting_names
from wasp_cli.spec.load import Loaded, chain_of, loaded, override
from wasp_cli.spec.read import InvalidSpec, Problem, parse


def read(text: str, *options: str) -> Loaded:
    return loaded(
        chain_of(parse(text, "x.yaml")),
        [override(number, option) for number, option in enumerate(options, start=1)],
    )


def refused(text: str, *options: str) -> Problem:
    with pytest.raises(InvalidSpec) as caught:
        read(text, *options)
    (problem,) = caught.value.problems
    return problem


def proposed(hint: str) -> list[str]:
    """The values that a hint proposes, as YAML."""
    for words in ("without quotes: ", "in quotes: ", "for example "):
        if words in hint:
            return [hint.partition(words)[2]]
    if match := re.fullmatch(r"write (\[.*\]) for this seed, (\[.*\]) for so many", hint):
        return [match[1], match[2]]
    if hint.startswith("did you mean"):
        return re.findall(r"'([^']*)'", hint)
    return [hint.removeprefix("write ")] if hint.startswith("write ") else []


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("seeds", "0-4", [[0, 1, 2, 3, 4]]),
        ("seeds", "0..4", [[0, 1, 2, 3, 4]]),
        ("seeds", "0 to 4", [[0, 1, 2, 3, 4]]),
        ("seeds", "range(5)", [[0, 1, 2, 3, 4]]),
        ("seeds", "range(2, 5)", [[2, 3, 4]]),
        ("seeds", "0,1,2", [[0, 1, 2]]),
        ("seeds", "'0, 1, 2'", [[0, 1, 2]]),
        ("seeds", "0 1 2", [[0, 1, 2]]),
        ("seeds", "5", [[5], [0, 1, 2, 3, 4]]),
        ("seeds", "'5'", [[5]]),
        ("seeds", "0", [[0]]),
        ("methods", "human, wasp", [["human", "wasp"]]),
        ("tasks", "goal1 race1", [["goal1", "race1"]]),
        ("operators", "noisy", [{"noisy": {"moderate": 0.5}}]),
        ("operators", "{noisy: 0.4}", [{"moderate": 0.4}]),
        ("operators", "{noisy: [0.2, 0.4]}", [{"mild": 0.2, "moderate": 0.4}]),
        ("operators", "{noisy: 5}", [{"moderate": 0.5}]),
        ("episodes", "'30'", [30]),
        ("episodes", "40,000", [40000]),
        ("episodes", "1k", [1000]),
        ("name", "5", ["5"]),
        ("preset", "Quick", ["quick"]),
    ],
)
def test_what_is_meant_is_proposed_and_accepted(field, value, expected):
    lines = [line for line in GOOD.splitlines() if not re.match(rf" |operators:|{field}:", line)]
    if field != "operators":
        lines.append("operators: {noisy: {mild: 0.2}}")
    problem = refused("\n".join([*lines, f"{field}: {value}"]))
    texts = proposed(problem.hint or "")
    assert [YAML(typ="safe").load(text) for text in texts] == expected
    for text in texts:
        inner = f"{{noisy: {text}}}" if value.startswith("{noisy") else text
        assert read("\n".join([*lines, f"{field}: {inner}"]))


@pytest.mark.parametrize(
    "line", ["seeds: true", "seeds: -1", "seeds: 0-4000000", "methods: Nobody", "episodes: '0'"]
)
def test_what_would_be_refused_as_well_is_not_proposed(line):
    field = line.partition(":")[0]
    lines = [other for other in GOOD.splitlines() if not other.startswith(field)]
    assert refused("\n".join([*lines, line])).hint is None


def test_a_range_within_a_list_is_written_out_in_its_place():
    assert refused(GOOD.replace("[0]", "[0-2, 7]")).hint == "write 0, 1, 2 in its place"
    assert refused(GOOD.replace("[0]", "[0-2, 1]")).hint is None, "1 would be there twice"


ODD: list[str] = [
    *("0-4", "0,1", "5", "'5'", "true", "'true'", "yes", "no", "1.5", "'1.5'", "-1", "[0-1]"),
    *("noisy", "{a: b}", "{a: 1}", "quick", "Human", "human wasp", "40k", "40_000", "'1e3'"),
    *("[noisy]", "calibrated", "calibratd", "2", "'0'", "[1, '2']", "full", "'null'", "a:b"),
]


@settings(deadline=None, max_examples=150)
@given(st.sampled_from(setting_names()), st.sampled_from(ODD))
def test_an_option_that_is_proposed_is_accepted(name: str, value: str) -> None:
    problems: tuple[Problem, ...] = ()
    try:
        read(GOOD, f"{name}={value}")
    except InvalidSpec as error:
        problems = error.problems
    except WaspError:
        return
    for problem in problems:
        if (problem.hint or "").startswith("write --set "):
            _, _, option = shlex.split(problem.hint or "")
            assert option.startswith(f"{name}=")
            assert wrong_at(name, option) == []


def wrong_at(name: str, option: str) -> list[Any]:
    """The problems of a spec under an option that name its setting."""
    try:
        read(GOOD, option)
    except InvalidSpec as error:
        return [problem for problem in error.problems if problem.message.startswith(name)]
    return []


def test_a_value_in_the_wrong_place_is_not_mended_there():
    with pytest.raises(InvalidSpec) as caught:
        read(GOOD, "planner.variant='null'")
    (problem,) = caught.value.problems
    assert "`variants: [full]` at the top" in (problem.hint or "")


def test_a_name_with_dots_is_told_where_it_is_written():
    problem = refused(f"{GOOD}wasp.candidates: 64\n")
    assert "write `candidates: 64` in the section 'wasp'" in (problem.hint or "")
    assert read(f"{GOOD}wasp: {{candidates: 64}}\n").spec.method("wasp")


@pytest.mark.parametrize(
    "line", ["seeds: {long}", "{long}: 1", "methods: [{long}]", "name: '{long}", "seeds: [{long}"]
)
def test_a_long_line_is_shown_around_its_mistake(line):
    with pytest.raises(InvalidSpec) as caught:
        read(GOOD.replace("seeds: [0]\n", "") + line.format(long="x" * 129_000))
    for problem in caught.value.problems:
        assert len(str(problem)) < 4000
        assert len(str(problem.as_json())) < 4000


def test_the_caret_stands_under_the_mistake_in_a_long_line():
    before = ", ".join(f"{seed}" for seed in range(1000))
    problem = refused(GOOD.replace("[0]", f"[{before}, wrong, {before.replace('0', '9')}]"))
    _, line, caret = str(problem).splitlines()[:3]
    assert line[caret.index("^") :].startswith("wrong")
    assert len(line) < 200
