from pathlib import Path

import pytest

from tests.spec.good import GOOD
from wasp_cli.errors import UsageError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.spec.load import Loaded, chain_of, load, loaded
from wasp_cli.spec.names import assistant_variants, training_stages
from wasp_cli.spec.read import InvalidSpec, Problem, parse
from wasp_cli.tasks.registry import TASKS

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


@pytest.mark.parametrize("path", sorted(path for path in SPECS.glob("*.yaml") if path.stem != "paper"), ids=lambda path: path.stem)
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
    [
        ("wasp:\n  candidats: 64\n", (9, 3), "unknown key 'candidats'", "did you mean 'candidates'?"),
        (
            "candidates: 64\n",
            (8, 1),
            "unknown key 'candidates'",
            "did you mean 'wasp.candidates', 'printed.candidates' or 'ida-guarded.candidates'?",
        ),
        ("wasp: {episodes: 3}\n", (8, 8), "unknown key 'episodes'", "'episodes' belongs at the top level, outside every section"),
        ("wasp: {tau_r: calib}\n", (8, 15), "should be a number or 'calibrated', not 'calib'", "did you mean 'calibrated'?"),
        ("wasp: {horizon: 3}\n", (8, 1), "residual_steps (5) is longer than horizon (3)", None),
        ("wasp: {variant: no-case2}\n", (8, 8), "'variant' is not set here", "write `variants: [full]` at the top, outside every section"),
        ("evaluate: {episodes: 3}\n", (8, 12), "'episodes' is not set here", "write `episodes: 30` at the top, outside every section"),
        ("wasp: 3\n", (8, 7), "should be a mapping of keys to values, not 3", None),
        ("returns: {gamma_c: .nan}\n", (8, 20), "should be a finite number, not nan", None),
        ("dataset: {mixture: {expert: 0.9}}\n", (8, 11), "the shares sum to 1.67, not 1", None),
        ("by_task: {goal1: {wasp: {candidats: 9}}}\n", (8, 26), "unknown key 'candidats'", "did you mean 'candidates'?"),
        ("by_task: {goal1: {wasp: {horizon: 3}}}\n", (8, 19), "residual_steps (5) is longer than horizon (3)", None),
        ("by_task: {goal1: {wsap: {}}}\n", (8, 19), "unknown section 'wsap'", "did you mean 'wasp'?"),
        (
            "by_task: {goal1: {evaluate: {safe_cost: 3}}}\n",
            (8, 19),
            "'evaluate' is the same for all tasks",
            "set 'evaluate' outside `by_task`",
        ),
        (
            "by_task: {goal1: {residual: {operators: {noisy: [0.2]}}}}\n",
            (8, 30),
            "'residual.operators' is the same for all tasks",
            "set 'residual.operators' outside `by_task`",
        ),
        (
            "by_task: {goal1: {wasp: {variant: full}}}\n",
            (8, 26),
            "'variant' is not set here",
            "write `variants: [full]` at the top, outside every section",
        ),
    ],
)  # fmt: skip
def test_mistakes_have_a_place_and_a_suggestion(addition, place, message, hint):
    problem = only(GOOD + addition)
    assert (at(problem), problem.message, problem.hint) == (place, message, hint)


@pytest.mark.parametrize(
    ("old", "new", "place", "message", "hint"),
    [
        ("[goal1]", "[goal7]", (3, 9), "unknown task 'goal7'", "did you mean 'goal0', 'goal1' or 'goal2'?"),
        ("[goal1]", "[goal1, goal1]", (3, 8), "'goal1' is listed twice", None),
        ("[goal1]", "[]", (3, 8), "should not be empty", "the tasks"),
        ("mild: 0.2", "mild: 1.2", (6, 17), "should lie between 0 and 1 (probability of a uniform action), not 1.2", None),
        ("noisy: {mild: 0.2}", "limited-skill: {mild: 0.3}", (6, 25), "no such value in expert.checkpoints",
         "checkpoints: 0.1, 0.25, 0.5, 1"),
        ("{mild: 0.2}", "{}", (6, 10), "should not be empty", None),
        ("seeds: [0]\n", "", (1, 1), "missing key 'seeds'", "evaluation seeds"),
        ("seeds: [0]", "seeds: [0]\nepisodes: 1000000000", (8, 11), "should be less than or equal to 100000, not 1000000000", None),
        ("seeds: [0]", "seeds:", (7, 1), "should be a list, not nothing (null)", None),
        ("name: good", "name: ../good", (1, 7), "'../good' is not a usable name",
         "letters, digits, dot, dash and underscore, beginning with a letter or a digit"),
        ("operators:\n  noisy: {mild: 0.2}\n", "", (1, 1), "the listed methods assist an operator; name at least one variant", None),
        ("[human, wasp]", "[]\nstages: []", (4, 10), "neither methods nor stages are listed",
         "name a method, or under `stages` what is to be trained"),
        ("[human, wasp]", "[]\nstages: [critics]\nvariants: [no-case2]", (6, 12), "unknown variant of the listed methods 'no-case2'",
         "known: full"),
        ("[human, wasp]", "[human]\nstages: [expert, evaluate]", (5, 18),
         "'evaluate' runs for a method", "list its method under `methods`"),
    ],
)  # fmt: skip
def test_wrong_names_and_values_are_told_where_they_stand(old, new, place, message, hint):
    assert old in GOOD
    problem = only(GOOD.replace(old, new))
    assert (at(problem), problem.message, problem.hint) == (place, message, hint)


def test_a_spec_may_train_and_evaluate_nothing_and_name_no_operators():
    assert read("name: x\ntasks: [goal1]\nmethods: [expert]\nseeds: [0]\n").spec.operators == {}
    spec = read("name: x\ntasks: [goal1]\nmethods: []\nstages: [critics, heldout]\nseeds: [0]\n").spec
    assert (spec.methods, spec.stages, spec.operators) == ((), ("critics", "heldout"), {})


def test_all_problems_come_at_once_in_file_order():
    text = GOOD.replace("goal1", "goal7").replace("0.2", "7").replace("[0]", "[0, 0]") + "extra: 1\nwasp: {alpha: x}\n"
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
    [
        ("", (1, 1), "the file is empty"),
        ("- a\n", (1, 1), "a spec is a mapping of keys to values, not a list"),
        ("hello\n", (1, 1), "a spec is a mapping of keys to values, not text"),
        ("a: [1\nb: 2\n", (2, 2), "not valid YAML: expected ',' or ']', but got ':'"),
        ("a: 1\nb: 2\na: 3\n", (3, 1), "found duplicate key 'a'"),
        ("a: 1\n\tb: 2\n", (2, 1), "not valid YAML: found character '\\t' that cannot start any token"),
        ("a: *x\n", (1, 4), "an alias (*) is no part of a spec"),
        ("a: 1\nb: &b {c: 2}\n", (2, 4), "an anchor (&) is no part of a spec"),
        ("a: {<<: {b: 1}}\n", (1, 5), "a merge (<<) is no part of a spec"),
        ("a: !!set {b}\n", (1, 4), "a tag (!) is no part of a spec"),
        ("a: 1\n---\nb: 1\n", (2, 1), "not valid YAML: but found another document"),
        ("name: \x01\n", (1, 7), "not a text file: special characters are not allowed"),
        ("a: " + "9" * 5000, (1, 4), "not valid YAML: '9999999999999999999999999999999999999...' is not an integer"),
        ("b: [x, 2020-13-45]\n", (1, 8), "not valid YAML: '2020-13-45' is not a valid date"),
        ("a: {b: [0x_]}\n", (1, 9), "not valid YAML: '0x_' is not an integer"),
        ("[" * 600, (1, 1), "nested too deeply"),
    ],
)
def test_what_is_not_a_yaml_mapping_is_refused_with_a_place(text, place, message):
    problem = only(text)
    assert at(problem) == place
    assert problem.message.startswith(message)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("2020-01-01", "a date is no value of a spec"),
        ("{[a]: b}", "a key should be a plain word, not a list"),
        ("{? {a: 1} : b}", "a key should be a plain word, not a mapping"),
        ("{~: b}", "a key should be a plain word, not None"),
        ("{.nan: b}", "a key should be a plain word, not so large a number"),
        ("{? 0x" + "f" * 5000 + " : b}", "a key should be a plain word, not so large a number"),
        ("{1: a, '1': b}", "found duplicate key '1'"),
        ("0x" + "f" * 5000, "is too large a number"),
        ('"\\ud800"', "holds an unpaired surrogate escape"),
        ('{"\\udfff": a}', "a key should be a plain word, not an unpaired surrogate escape"),
        ("[" * 40 + "]" * 40, "nested too deeply"),
    ],
)
def test_values_without_a_plain_form_are_refused(value, message):
    assert any(problem.message.startswith(message) for problem in problems(f"{GOOD}extra: {value}\n"))


def test_settings_are_validated_as_if_they_stood_in_the_file(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text(GOOD, encoding="utf-8")
    spec = load(path, ["wasp.candidates=16", "seeds=[3, 4]", "operators.noisy.mild=0.3", "training_seed=null"]).spec
    assert spec.method("wasp").model_dump()["candidates"] == 16
    assert (spec.seeds, spec.operators, spec.training_seed) == ((3, 4), {"noisy": {"mild": 0.3}}, None)
    with pytest.raises(InvalidSpec) as caught:
        load(path, ["wasp.candidats=16", "seeds=x"])
    assert [problem.place for problem in caught.value.problems] == ["--set seeds=x", "--set wasp.candidats=16"]
    assert "wasp.candidats: unknown key 'candidats'" in caught.value.message
    for text in ("x", "=1", "a..b=1", "seeds=[1", "seeds=1\ntasks: []"):
        with pytest.raises(UsageError, match="--set #1"):
            load(path, [text])


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
        ("by_task: {goal1: 0.2}\n", "with a name, for example {moderate: 0.2}"),
    ],
)  # fmt: skip
def test_keys_and_values_have_suggestions(addition, hint):
    assert only(GOOD + addition).hint == hint


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
