"""The JSON Schema of a spec: current, true to the shipped specs, and against the mistakes that an editor should mark."""

from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.commands import run_here
from tests.spec import good
from wasp_cli.methods.registry import METHODS, MethodInfo
from wasp_cli.spec.model import spec_type
from wasp_cli.spec.read import parse, read
from wasp_cli.spec.schema import FOREIGN, spec_schema
from wasp_cli.tasks.registry import is_foreign

SPECS = Path(__file__).parents[2] / "specs"
FILE = SPECS / "wasp.schema.json"
MODELINE = f"# yaml-language-server: $schema={FILE.name}"

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
    done = run_here("schema", columns=80)
    assert done.exit_code == 0
    assert FILE.read_text(encoding="utf-8") == done.stdout, "wasp schema > specs/wasp.schema.json"


@pytest.mark.parametrize("path", sorted(path for path in SPECS.glob("*.yaml") if path.stem != "paper"), ids=lambda path: path.stem)
def test_shipped_specs_validate_and_name_the_schema(path, validator):
    validator.validate(read(path).document)
    assert path.read_text(encoding="utf-8").startswith(MODELINE + "\n")


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        GOOD.replace("tasks: [goal1, my_pkg:MyEnv-v0]", "task: goal1"),
        "extends: base.yaml\nname: over\n",
        "extends: quickstart\nname: over\n",
        "extends: base.yaml\nname: over\ntask: CartPole-v1\nwasp: {candidates: 8}\n",
        GOOD + "episodes: 1e1\nfilter: {tau_c: calibrated}\nwasp: {tau_r: 0.3}\ntraining_seed: null\n",
        GOOD + "residual: {operators: {laggy: [0.5]}}\nevaluate: {success_goals: null}\n",
        GOOD + "by_task: {formula1: {world_model: {privileged: 25}, policies: {hidden: [256, 256]}}}\n",
    ],
)
def test_what_specs_may_write_validates(text, validator):
    assert list(validator.iter_errors(document(text))) == []


MISTAKES = [
    ("name: good", "name: ../good"), ("seeds: [0]\n", ""), ("tasks: [goal1, my_pkg:MyEnv-v0]\n", ""), ("noisy", "nosiy"),
    ("{mild: 0.2}", "0.2"),
    *(("seeds: [0]", f"seeds: [0]\n{line}") for line in (
        "episode: 3", "task: goal1", "extends: base.json", "wasp: {candidats: 8}", "wasp: {variant: full}", "evaluate: {episodes: 3}",
        "by_task: {goal1: {evaluate: {success_goals: 3}}}", "residual: {operators: {nosiy: [0.5]}}", "stages: [worldmodel]",
        "variants: [no-case]",
    )),
]  # fmt: skip


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
    assert printed["tau_r_quantile"] == {
        "default": 0.95, "description": "which one", "exclusiveMaximum": 1.0, "exclusiveMinimum": 0.0, "type": "number"
    }  # fmt: skip
    assert wasp["candidates"] == {"description": "N, section 5.1", "minimum": 4, "type": "integer"}
    assert set(schema["properties"]) == {*spec_type().model_fields, "extends", "task"}


def test_names_of_plugins_are_there(monkeypatch):
    plugin = MethodInfo("mine", "Mine", "mine:Mine", "wasp_cli.methods.configs:IDAConfig", variants=("full", "half"))
    monkeypatch.setattr(METHODS, "_all", {**METHODS, "mine": plugin})
    spec_type.cache_clear()
    try:
        own = spec_schema()["properties"]
    finally:
        spec_type.cache_clear()
    assert "mine" in own
    assert "mine" in own["methods"]["items"]["enum"]
    assert "half" in own["variants"]["items"]["enum"]
