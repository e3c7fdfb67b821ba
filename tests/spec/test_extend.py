"""A spec over another one: what is in force, where mistakes are shown, and what a run records."""

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.spec.good import mistakes
from wasp_cli.cells.asked import asked_of
from wasp_cli.cells.runs import read_run
from wasp_cli.errors import UsageError
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import plan_against
from wasp_cli.run.record import new_run
from wasp_cli.spec.load import LONGEST_CHAIN, load, restricted
from wasp_cli.spec.read import InvalidSpec

BASE = """\
name: base
preset: smoke
tasks: [goal1, race1]
methods: [human, wasp]
operators:
  noisy: {mild: 0.2, severe: 0.6}
seeds: [0, 1]
wasp: {candidates: 10, elites: 4}
"""
OUT_OF_RANGE = "should lie between 0 and 1 (probability of a uniform action)"
FAST = "extends: base.yaml\nname: fast\n"


@pytest.fixture
def base(tmp_path) -> Path:
    return written(tmp_path, "base", BASE)


def written(folder: Path, name: str, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def places(path: Path, *settings: str) -> list[tuple[str, tuple[int, int] | None, str]]:
    """(file or option, place, message) of every problem."""
    with pytest.raises(InvalidSpec) as caught:
        load(path, settings)
    assert caught.value.exit_code == 3
    found = [
        (Path(problem.source).name, problem.position, problem.message)
        for problem in caught.value.problems
    ]
    return [
        (name, position and (position.line, position.column), message)
        for name, position, message in found
    ]


def test_sections_merge_and_everything_else_replaces(base):
    path = written(
        base.parent,
        "fast",
        FAST
        + "seeds: [7]\noperators:\n  noisy: {mild: 0.3}\n  laggy: {x: 0.5}\nwasp: {elites: 3}\n",
    )
    spec = load(path).spec
    assert (spec.name, spec.tasks, spec.seeds) == ("fast", ("goal1", "race1"), (7,))
    assert spec.operators == {"noisy": {"mild": 0.3, "severe": 0.6}, "laggy": {"x": 0.5}}
    assert {"candidates": 10, "elites": 3, "iterations": 2}.items() <= spec.method(
        "wasp"
    ).model_dump().items()


def test_nothing_in_place_of_a_section_removes_it(base):
    path = written(
        base.parent, "fast", FAST + "operators:\n  noisy: null\n  person: {p1: 1}\nseeds: [7]\n"
    )
    assert load(path).spec.operators == {"person": {"p1": 1}}
    path = written(base.parent, "fast", FAST + "wasp: null\n")
    specs = [load(path).spec, load(base, ["wasp=null"]).spec]
    base.write_text(BASE.replace("wasp: {candidates: 10, elites: 4}", ""), encoding="utf-8")
    assert [spec.wasp.candidates for spec in (*specs, load(path).spec)] == [8, 8, 8], "the preset's"


def test_severities_go_from_mild_to_severe_whichever_file_wrote_them(base):
    text = FAST + "operators:\n  noisy: {moderate: 0.4}\n  laggy: {weak: 0.7, strong: 0.4}\n"
    operators = load(written(base.parent, "fast", text)).spec.operators
    assert list(operators["noisy"].items()) == [("mild", 0.2), ("moderate", 0.4), ("severe", 0.6)]
    assert list(operators["laggy"]) == ["weak", "strong"], "other names stay as they are written"


def test_the_short_form_replaces_the_list_and_the_list_the_short_form(base):
    fast = written(base.parent, "fast", FAST + "task: race1\n")
    assert load(fast).spec.tasks == ("race1",)
    again = written(
        base.parent, "again", "extends: fast.yaml\nname: again\ntasks: [goal1, goal2]\n"
    )
    assert load(again).spec.tasks == ("goal1", "goal2")
    fast.write_text(FAST + "task: goal7\n", encoding="utf-8")
    assert places(fast) == [("fast.yaml", (3, 7), "unknown task 'goal7'")]


def test_a_chain_goes_through_folders(base):
    middle = written(
        base.parent / "below", "middle", "extends: ../base.yaml\nname: middle\nseeds: [5]\n"
    )
    last = written(base.parent, "last", f"extends: {middle}\nname: last\nepisodes: 4\n")
    spec = load(last).spec
    assert (spec.name, spec.seeds, spec.episodes, spec.methods) == (
        "last",
        (5,),
        4,
        ("human", "wasp"),
    )


def test_every_mistake_stands_in_the_file_that_wrote_it(base):
    base.write_text(
        BASE.replace("race1", "rase1")
        .replace("elites: 4", "elites: 4, alhpa: 1")
        .replace("0.6", "6"),
        encoding="utf-8",
    )
    path = written(
        base.parent,
        "fast",
        FAST + "operators:\n  noisy: {mild: 2}\nwasp: {elites: x}\nseeds: [-1]\n",
    )
    assert places(path) == [
        ("fast.yaml", (4, 17), f"{OUT_OF_RANGE}, not 2"),
        ("fast.yaml", (5, 16), "should be an integer, not 'x'"),
        ("fast.yaml", (6, 9), "should be greater than or equal to 0, not -1"),
        ("base.yaml", (3, 16), "unknown task 'rase1'"),
        ("base.yaml", (6, 30), f"{OUT_OF_RANGE}, not 6"),
        ("base.yaml", (8, 35), "unknown key 'alhpa'"),
    ]


def test_what_is_missing_in_all_files_is_missing_in_the_nearest(base):
    base.write_text(BASE.replace("seeds: [0, 1]\n", ""), encoding="utf-8")
    assert places(written(base.parent, "fast", FAST)) == [
        ("fast.yaml", (1, 1), "missing key 'seeds'")
    ]


def test_the_name_is_said_by_the_file_itself(base):
    path = written(base.parent, "fast", "preset: quick\nextends: base.yaml\n")
    assert places(path) == [("fast.yaml", (2, 1), "missing key 'name'")]
    assert load(path, ["name=other"]).spec.name == "other"
    base.write_text(BASE.replace("name: base\n", ""), encoding="utf-8")
    assert (
        load(written(base.parent, "named", "extends: base.yaml\nname: named\n")).spec.name
        == "named"
    )


@pytest.mark.parametrize(
    ("value", "message"), mistakes("extend: what cannot be extended is refused where it is said")
)
def test_what_cannot_be_extended_is_refused_where_it_is_said(base, value, message):
    path = written(base.parent, "fast", f"name: fast\nextends: {value}\n")
    ((file, place, found),) = places(path)
    assert (file, found) == ("fast.yaml", message.format(folder=base.parent))
    assert place in ((2, 10), (2, 1))


def test_a_base_that_does_not_read_shows_its_own_place(base):
    path = written(base.parent, "fast", FAST)
    base.write_text("name: }\n", encoding="utf-8")
    assert places(path)[0][0] == "base.yaml"
    base.write_bytes(b"name: \xff")
    assert places(path) == [("base.yaml", (1, 7), "not a text file: byte 0xff is not UTF-8")]
    base.unlink()
    base.mkdir()
    assert places(path) == [("base.yaml", (1, 1), "is a folder, not a spec file")]


def test_a_chain_that_comes_back_is_refused_where_it_does(tmp_path):
    for name, other in (("a", "b"), ("b", "c"), ("c", "sub/../b")):
        written(tmp_path, name, f"name: {name}\nextends: {other}.yaml\n")
    (tmp_path / "sub").mkdir()
    ((file, place, message),) = places(tmp_path / "a.yaml")
    assert (file, place) == ("c.yaml", (2, 10))
    assert (
        message
        == f"extends itself: {tmp_path}/b.yaml -> {tmp_path}/c.yaml -> {tmp_path}/sub/../b.yaml"
    )
    itself = written(tmp_path, "self", "name: self\nextends: self.yaml\n")
    assert [place[:2] for place in places(itself)] == [("self.yaml", (2, 10))]


def test_a_chain_has_a_longest_length(base):
    for number in range(2, LONGEST_CHAIN + 2):
        before = "base" if number == 2 else f"s{number - 1}"
        written(base.parent, f"s{number}", f"name: s{number}\nextends: {before}.yaml\n")
    assert load(base.parent / f"s{LONGEST_CHAIN}.yaml").spec.name == f"s{LONGEST_CHAIN}"
    assert places(base.parent / f"s{LONGEST_CHAIN + 1}.yaml") == [
        ("s2.yaml", (2, 10), "a chain of more than 8 files")
    ]


def test_extends_stands_at_the_top_of_a_file(base):
    path = written(base.parent, "fast", FAST + "wasp:\n  extends: base.yaml\n")
    assert places(path) == [("fast.yaml", (4, 3), "unknown key 'extends'")]
    assert places(written(base.parent, "typo", "extend: base.yaml\n" + BASE)) == [
        ("typo.yaml", (1, 1), "unknown key 'extend'")
    ]
    assert places(base, "extends=base.yaml") == [
        ("--set extends=base.yaml", None, "extends: unknown key 'extends'")
    ]


def test_options_lie_over_all_files(base):
    path = written(base.parent, "fast", FAST + "wasp: {elites: 3}\n")
    assert load(path, ["operators.noisy.mild=0.1"]).spec.operators == {
        "noisy": {"mild": 0.1, "severe": 0.6}
    }
    assert places(path, "wasp.elites=x", "operators.noisy={mild: 3}", "wasp.candidates=0") == [
        ("--set operators.noisy={mild: 3}", None, f"operators.noisy.mild: {OUT_OF_RANGE}, not 3"),
        (
            "--set wasp.candidates=0",
            None,
            "wasp.candidates: should be greater than or equal to 4, not 0",
        ),
        ("--set wasp.elites=x", None, "wasp.elites: should be an integer, not 'x'"),
    ]
    with pytest.raises(UsageError):
        load(path, ["wasp.elites"])


def test_a_run_records_every_file(base, layout):
    path = written(base.parent, "fast", FAST + "seeds: [0]  # one is enough\n")

    def recorded(spec: Path) -> str:
        loaded = load(spec)
        run = new_run(layout, loaded, plan_against(lay_out(loaded.spec), layout))
        return (layout.run(run) / "spec.yaml").read_text(encoding="utf-8")

    assert recorded(base) == BASE
    text = recorded(path)
    assert text == f"---\n# {path}\n{FAST}seeds: [0]  # one is enough\n---\n# {base}\n{BASE}"
    assert [document["name"] for document in YAML(typ="safe").load_all(text)] == ["fast", "base"]
    part = restricted(load(base, ["variants=[full, no-case2]"]), None, ["human"])
    run_id = new_run(layout, part, plan_against(lay_out(part.spec), layout))
    assert asked_of(read_run(layout, run_id)).unknown == (), "it has wasp's ablations"
