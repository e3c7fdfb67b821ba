from pathlib import Path

import pytest

from tests.spec.good import GOOD, mistakes
from wasp_cli.errors import UsageError
from wasp_cli.spec.load import Loaded, chain_of, load, loaded
from wasp_cli.spec.read import InvalidSpec, Problem, parse

SPECS = Path(__file__).parents[2] / "specs"


def read(text: str) -> Loaded:
    return loaded(chain_of(parse(text, "x.yaml")))


def problems(text: str) -> tuple[Problem, ...]:
    with pytest.raises(InvalidSpec) as caught:
        read(text)
    assert caught.value.exit_code == 3
    return caught.value.problems


def only(text: str) -> Problem:
    (problem,) = problems(text)
    return problem


def at(problem: Problem) -> tuple[int, int]:
    return problem.position.line, problem.position.column


@pytest.mark.parametrize(
    "path",
    sorted(path for path in SPECS.glob("*.yaml") if path.stem != "paper"),
    ids=lambda path: path.stem,
)
def test_shipped_specs_are_valid(path):
    assert load(path).spec.name == path.stem


def test_presets_lie_under_the_file():
    spec = read(GOOD + "wasp: {candidates: 10}\nworld_model: {updates: 7}\n").spec
    assert spec.method("wasp").model_dump()["candidates"] == 10
    assert spec.method("wasp").model_dump()["iterations"] == 2
    assert spec.stage("world_model").model_dump()["updates"] == 7
    assert spec.stage("world_model").model_dump()["deter"] == 32


def test_episodes_at_the_top_reach_the_evaluation():
    assert read(GOOD + "episodes: 9\n").spec.stage("evaluate").model_dump()["episodes"] == 9
    assert read(GOOD).spec.stage("evaluate").model_dump()["episodes"] == 2


@pytest.mark.parametrize(
    ("addition", "place", "message", "hint"),
    mistakes("load: mistakes have a place and a suggestion"),
)
def test_mistakes_have_a_place_and_a_suggestion(addition, place, message, hint):
    problem = only(GOOD + addition)
    assert (at(problem), problem.message, problem.hint) == (place, message, hint)


@pytest.mark.parametrize(
    ("old", "new", "place", "message", "hint"),
    mistakes("load: wrong names and values are told where they stand"),
)
def test_wrong_names_and_values_are_told_where_they_stand(old, new, place, message, hint):
    assert old in GOOD
    problem = only(GOOD.replace(old, new))
    assert (at(problem), problem.message, problem.hint) == (place, message, hint)


def test_a_spec_may_train_and_evaluate_nothing_and_name_no_operators():
    assert read("name: x\ntasks: [goal1]\nmethods: [expert]\nseeds: [0]\n").spec.operators == {}
    spec = read(
        "name: x\ntasks: [goal1]\nmethods: []\nstages: [critics, heldout]\nseeds: [0]\n"
    ).spec
    assert (spec.methods, spec.stages, spec.operators) == ((), ("critics", "heldout"), {})


def test_all_problems_come_at_once_in_file_order():
    text = (
        GOOD.replace("goal1", "goal7").replace("0.2", "7").replace("[0]", "[0, 0]")
        + "extra: 1\nwasp: {alpha: x}\n"
    )
    assert [at(problem) for problem in problems(text)] == [(3, 9), (6, 17), (7, 8), (8, 1), (9, 15)]


def test_stages_mix_known_operators_at_known_values():
    text = GOOD + "residual: {operators: {nosy: [0.1], noisy: [2], limited-skill: [0.3]}}\n"
    assert [problem.message.split(",")[0] for problem in problems(text)] == [
        "unknown operator variant 'nosy'",
        "should lie between 0 and 1 (probability of a uniform action)",
        "no such value in expert.checkpoints",
    ]


@pytest.mark.parametrize(
    ("text", "place", "message"),
    mistakes("load: what is not a yaml mapping is refused with a place"),
)
def test_what_is_not_a_yaml_mapping_is_refused_with_a_place(text, place, message):
    problem = only(text)
    assert at(problem) == place
    assert problem.message.startswith(message)


@pytest.mark.parametrize(
    ("value", "message"), mistakes("load: values without a plain form are refused")
)
def test_values_without_a_plain_form_are_refused(value, message):
    assert any(
        problem.message.startswith(message) for problem in problems(f"{GOOD}extra: {value}\n")
    )


def test_settings_are_validated_as_if_they_stood_in_the_file(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text(GOOD, encoding="utf-8")
    spec = load(
        path,
        ["wasp.candidates=16", "seeds=[3, 4]", "operators.noisy.mild=0.3", "training_seed=null"],
    ).spec
    assert spec.method("wasp").model_dump()["candidates"] == 16
    assert (spec.seeds, spec.operators, spec.training_seed) == (
        (3, 4),
        {"noisy": {"mild": 0.3}},
        None,
    )
    with pytest.raises(InvalidSpec) as caught:
        load(path, ["wasp.candidats=16", "seeds=x"])
    assert [problem.place for problem in caught.value.problems] == [
        "--set seeds=x",
        "--set wasp.candidats=16",
    ]
    assert "wasp.candidats: unknown key 'candidats'" in caught.value.message
    with pytest.raises(InvalidSpec, match=r"^--set operators.lagy.a=0.4: "):
        load(path, ["operators.lagy.a=0.4"])
    for text in ("x", "=1", "a..b=1", "seeds=[1", "seeds=1\ntasks: []"):
        with pytest.raises(UsageError, match="--set #1"):
            load(path, [text])


def test_a_setting_counts_for_tasks_that_have_a_value_of_their_own(tmp_path):
    spec = tmp_path / "own.yaml"
    spec.write_text(GOOD + "by_task: {goal1: {wasp: {tau_c: 2.0, alpha: 0.5}}}\n", encoding="utf-8")
    own = load(spec, ["wasp.tau_c=0.5"]).spec.method("wasp", "full", "goal1").model_dump()
    assert (own["tau_c"], own["alpha"]) == (0.5, 0.5)
    assert (
        load(spec, ["by_task.goal1.wasp.tau_c=0.7"])
        .spec.method("wasp", "full", "goal1")
        .model_dump()["tau_c"]
        == 0.7
    )


@pytest.mark.parametrize(
    ("addition", "settings", "place"),
    [
        ("wasp: {elites: 5000}\n", ["wasp.alpha=0.1"], "wrong.yaml"),
        ("", ["wasp.elites=5000", "wasp.alpha=0.1"], "--set wasp.elites=5000"),
        ("wasp: {alpha: 0.2}\n", ["wasp.alpha=0.1", "wasp.elites=5000"], "--set wasp.elites=5000"),
    ],
)
def test_what_is_wrong_with_a_section_is_told_of_what_brought_it(
    tmp_path, addition, settings, place
):
    spec = tmp_path / "wrong.yaml"
    spec.write_text(GOOD + addition, encoding="utf-8")
    with pytest.raises(InvalidSpec) as caught:
        load(spec, settings)
    (problem,) = caught.value.problems
    assert problem.source.endswith(place)


def test_files_that_cannot_be_read_say_so(tmp_path):
    (tmp_path / "a.yaml").write_text(GOOD, encoding="utf-8")
    (tmp_path / "binary").write_bytes(b"name: x\nno: \xff\xfe")
    for path, message in (
        (tmp_path / "b.yaml", "no such file"),
        (tmp_path, "is a folder"),
        (tmp_path / "binary", "byte 0xff is not UTF-8"),
    ):
        with pytest.raises(InvalidSpec, match=message) as caught:
            load(path)
        assert caught.value.problems[0].position is not None
    assert at(caught.value.problems[0]) == (2, 5)


@pytest.mark.parametrize(("addition", "hint"), mistakes("load: keys and values have suggestions"))
def test_keys_and_values_have_suggestions(addition, hint):
    assert only(GOOD + addition).hint == hint


def test_control_characters_of_a_value_do_not_reach_the_terminal():
    shown = str(only(GOOD.replace("[goal1]", '["\\e[31mred\\a"]')))
    assert all(character.isprintable() or character == "\n" for character in shown)
    assert "\x1b" not in str(only(GOOD + "wasp: {alpha: \x1b}\n"))
