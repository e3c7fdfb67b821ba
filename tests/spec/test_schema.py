"""The JSON Schema of a spec: current, true to the shipped specs, and against the mistakes that
an editor should mark.
"""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.commands import ROOT, run_here
from tests.spec import good
from wasp_cli.methods.registry import METHODS, MethodInfo
from wasp_cli.spec.load import load
from wasp_cli.spec.model import spec_type
from wasp_cli.spec.read import parse, read
from wasp_cli.spec.schema import FOREIGN, spec_schema
from wasp_cli.spec.shipped import shipped_names, spec_path, specs_folder
from wasp_cli.tasks.registry import is_foreign

SPECS = ROOT / "specs"
FILE = SPECS / "wasp.schema.json"

GOOD = good.GOOD.replace("[goal1]", "[goal1, my_pkg:MyEnv-v0]")


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    schema = spec_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def document(text: str) -> dict[str, Any]:
    source = parse(text, "x.yaml")
    assert not source.problems
    return source.document


def test_the_committed_file_is_current():
    assert FILE.read_text(encoding="utf-8") == run_here("schema", columns=80, code=0).stdout, (
        "wasp schema > specs/wasp.schema.json"
    )


@pytest.mark.parametrize(
    "path",
    sorted(path for path in SPECS.glob("*.yaml") if path.stem != "paper"),
    ids=lambda path: path.stem,
)
def test_shipped_specs_validate_and_name_the_schema(path, validator):
    validator.validate(read(path).document)
    assert path.read_text(encoding="utf-8").startswith(
        f"# yaml-language-server: $schema={FILE.name}\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        GOOD.replace("tasks: [goal1, my_pkg:MyEnv-v0]", "task: goal1"),
        "extends: base.yaml\nname: over\n",
        "extends: quickstart\nname: over\n",
        "extends: base.yaml\nname: over\ntask: CartPole-v1\nwasp: {candidates: 8}\n",
        GOOD
        + "episodes: 1e1\nfilter: {tau_c: calibrated}\nwasp: {tau_r: 0.3}\ntraining_seed: null\n",
        GOOD + "residual: {operators: {laggy: [0.5]}}\nevaluate: {success_goals: null}\n",
        "extends: table1\nname: over\nmethods: [human, halfway:Halfway]\nwasp: "
        "null\nexpert: null\n",
        GOOD
        + "by_task: {formula1: {world_model: {privileged: 25}, policies: {hidden: [256, 256]}}}\n",
    ],
)
def test_what_specs_may_write_validates(text, validator):
    assert list(validator.iter_errors(document(text))) == []


MISTAKES = [
    ("name: good", "name: ../good"),
    ("seeds: [0]\n", ""),
    ("tasks: [goal1, my_pkg:MyEnv-v0]\n", ""),
    ("noisy", "nosiy"),
    ("{mild: 0.2}", "0.2"),
    ("[human, wasp]", "[human, my module:Mine]"),
    *(
        ("seeds: [0]", f"seeds: [0]\n{line}")
        for line in (
            "episode: 3",
            "task: goal1",
            "extends: base.json",
            "wasp: {candidats: 8}",
            "wasp: {variant: full}",
            "evaluate: {episodes: 3}",
            "by_task: {goal1: {evaluate: {success_goals: 3}}}",
            "residual: {operators: {nosiy: [0.5]}}",
            "stages: [worldmodel]",
            "variants: [no-case]",
        )
    ),
]


@pytest.mark.parametrize(("old", "new"), MISTAKES)
def test_typical_mistakes_do_not_validate(old, new, validator):
    assert old in GOOD
    assert not validator.is_valid(document(GOOD.replace(old, new)))


@given(
    st.text("aZ_-./:v10 é", max_size=12)
    | st.text(max_size=12)
    | st.sampled_from(["wasp/", "wasp_cli.tasks.gym:wasp/", "m:wasp/"]).map("{}X-v0".format)
)
def test_a_gymnasium_id_is_what_the_registry_takes_for_one(name):
    assume(not name.endswith("\n"))  # before which `$` matches too, in Python and not in a schema
    assert jsonschema.Draft202012Validator({"pattern": FOREIGN}).is_valid(name) == is_foreign(name)


def test_fields_say_what_they_mean_and_no_default_that_presets_change():
    schema = spec_schema()
    wasp, printed = (schema["$defs"][f"{name}Config"]["properties"] for name in ("WASP", "Printed"))
    tau_r_quantile = dict(printed["tau_r_quantile"])
    assert "tau_r" in tau_r_quantile.pop("description")
    assert tau_r_quantile == {
        "default": 0.95,
        "exclusiveMaximum": 1.0,
        "exclusiveMinimum": 0.0,
        "type": "number",
    }
    assert wasp["candidates"] == {"description": "N, section 5.1", "minimum": 4, "type": "integer"}
    assert set(schema["properties"]) == {*spec_type().model_fields, "extends", "task"} - {
        "environments"  # what a file writes in `tasks`
    }


def test_names_of_plugins_are_there(monkeypatch):
    plugin = MethodInfo(
        "mine", "Mine", "mine:Mine", "wasp_cli.methods.configs:IDAConfig", variants=("full", "half")
    )
    monkeypatch.setattr(METHODS, "_all", {**METHODS, "mine": plugin})
    spec_type.cache_clear()
    try:
        own = spec_schema()["properties"]
    finally:
        spec_type.cache_clear()
    assert "mine" in own
    assert "mine" in own["methods"]["items"]["anyOf"][0]["enum"]
    assert "half" in own["variants"]["items"]["enum"]


# Specs by name, from any folder; and a wheel that brings them and the published parts, installed
# into an empty folder.


@pytest.fixture
def elsewhere(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "typed", ["quickstart", "quickstart.yaml", "specs/quickstart.yaml", "specs/quickstart"]
)
def test_a_spec_is_found_by_its_name(typed, elsewhere):
    (elsewhere / "quickstart").mkdir()  # a folder is none
    assert spec_path(Path(typed)) == ROOT / "specs" / "quickstart.yaml"
    assert load(Path(typed)).spec.name == "quickstart"


@pytest.mark.parametrize(
    ("typed", "file"),
    [
        ("away", "away/away.yaml"),
        ("away/lunar_lander", "away/lunar_lander.yaml"),
        ("away/lunar_lander.yaml", "away/lunar_lander.yaml"),
    ],
)
def test_a_spec_with_modules_of_its_own_is_found_by_its_name(typed, file, elsewhere):
    (elsewhere / "away").mkdir()  # a folder is none
    assert spec_path(Path(typed)) == ROOT / "specs" / file
    assert typed.removesuffix(".yaml") in shipped_names()


@pytest.mark.parametrize(
    "typed",
    [
        "mine/quickstart.yaml",
        "away/quickstart",
        "../quickstart",
        "quickstart.txt",
        "/quickstart",
        "quick\nstart",
        "nothing",
        "",
    ],
)
def test_nothing_else_is_taken_for_a_name(typed, elsewhere):
    assert spec_path(Path(typed)) == Path(typed)


def test_a_file_that_is_there_comes_first(elsewhere):
    assert run_here("init", columns=200).exit_code == 0
    shipped = {
        path.relative_to(specs_folder())
        for pattern in ("*.yaml", "*.json", "*/*.yaml", "*/*.py")
        for path in specs_folder().glob(pattern)
    }
    written = {path.relative_to("specs") for path in Path("specs").rglob("*") if not path.is_dir()}
    assert written == shipped
    Path("specs/table1.yaml").write_text("name: mine\n")
    assert "specs/table1.yaml: is there, not changed" in run_here("init", columns=200).output
    assert Path("specs/table1.yaml").read_text() == "name: mine\n"
    assert spec_path(Path("smoke")) == Path("specs/smoke.yaml")
    Path("smoke").write_text("name: own\n")
    assert spec_path(Path("smoke")) == Path("smoke")


@pytest.mark.parametrize("value", ["quickstart", "quickstart.yaml", "specs/quickstart.yaml"])
def test_a_shipped_spec_is_extended_by_its_name_from_any_folder(value, elsewhere):
    mine = elsewhere / "own" / "mine.yaml"
    mine.parent.mkdir()
    mine.write_text(f"extends: {value}\nname: mine\nseeds: [7]\n")
    spec = load(mine).spec
    assert (spec.name, spec.seeds, spec.tasks) == (
        "mine",
        (7,),
        load(Path("quickstart")).spec.tasks,
    )
    (mine.parent / "quickstart.yaml").write_text(
        "name: nearer\ntasks: [race1]\nmethods: [human]\noperators: {laggy: {moderate: 0.7}}\n"
    )
    assert load(mine).spec.tasks == (
        load(Path("quickstart")).spec.tasks if "/" in value else ("race1",)
    ), "a file beside it comes first"


@pytest.mark.parametrize("command", [("check",), ("run",), ("sweep", "--vary", "episodes=1,2")])
def test_an_unknown_name_is_answered_with_those_there_are(command, elsewhere):
    (elsewhere / "other.yaml").write_text("name: other\n")
    assert (
        f"known: other, {', '.join(shipped_names())}"
        in run_here(*command, "nope", columns=200, code=3).output
    )
    assert "did you mean 'quickstart'?" in run_here(*command, "quikstart", columns=200).output


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("goal9", "unknown task or spec 'goal9'\n       did you mean 'goal0', 'goal1' or 'goal2'?"),
        ("studdy", "did you mean 'study'?"),
        ("puddle:Puddle-v0", "'puddle:Puddle-v0' is an environment of another package"),
        ("mine/study.yaml", "mine/study.yaml:1:1: no such file"),
    ],
)
def test_a_word_that_cannot_be_driven_is_answered_with_those_that_can(typed, message, elsewhere):
    for more in ((), ("--withdraw",)):
        done = run_here("drive", typed, *more, columns=200)
        assert done.exit_code in (2, 3)
        assert message in done.output


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder that a wheel of this tree was installed into, without what it needs."""
    builder = pytest.importorskip("hatchling.build")
    place = tmp_path_factory.mktemp("wheel")
    before = Path.cwd()
    os.chdir(ROOT)
    try:
        name = builder.build_wheel(str(place))
    finally:
        os.chdir(before)
    with zipfile.ZipFile(place / name) as wheel:  # an archive of what is installed
        wheel.extractall(place / "site")
    return place / "site"


@pytest.mark.slow
def test_an_installed_wheel_has_the_specs_and_the_published_parts(installed, tmp_path):
    code = f"""
import sys
sys.path.insert(0, {str(installed)!r})
import wasp_cli
from wasp_cli.cli import main

print(wasp_cli.__file__)
for command in (["check", "quickstart", "specs/table1.yaml", "paper"], ["plan", "quickstart", "--json"]):
    sys.argv[1:] = command
    try:
        main()
    except SystemExit as end:
        print(end.code)
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    where, checked, _, _, code_of_check, plan = done.stdout.split("\n", 5)
    assert where.startswith(str(installed)), "another installation was asked"
    assert checked == "quickstart: ok, 29 cells"
    plan, _, code_of_plan = plan.strip().rpartition("\n")
    assert code_of_check == code_of_plan == "0", done.stderr
    assert not list(tmp_path.iterdir())
    counted = "published/contents.json"
    shipped = (installed / "wasp_cli" / counted).read_bytes()
    assert shipped == (ROOT / "results" / counted).read_bytes()
    states = {node["label"]: node["state"] for node in json.loads(plan)["nodes"]}
    assert (
        states["goal1 s1 world_model"]
        == states["goal1 s1 policies"]
        == states["goal1 s1 critics"]
        == "published"
    )
    spec, results = ROOT / "specs" / "quickstart.yaml", tmp_path / "results"
    here = json.loads(run_here("plan", spec, "--results", results, "--json", columns=200).stdout)
    assert states == {node["label"]: node["state"] for node in here["nodes"]}
