"""A package of someone else brings a training stage and a method that needs it, through entry
points alone.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import pytest
from click.testing import Result

from tests.commands import run_here
from tests.plugins import forget, installed
from wasp_cli.spec.schema import spec_schema

ENTRIES = """
[wasp.stages]
habits = outsider.entries:STAGE
[wasp.methods]
nudge = outsider.entries:METHOD
"""
REGISTERED = """
from wasp_cli.methods.registry import MethodInfo
from wasp_cli.stages.registry import StageInfo

STAGE = StageInfo("habits", "outsider.stage:HabitsStage", presets={"smoke": {"updates": 3}})
METHOD = MethodInfo("nudge", "Nudge", "outsider.method:Nudge", "outsider.settings:NudgeConfig", needs=("habits",))
"""
SETTINGS = """
from wasp_cli.config import Config, assumed

class NudgeConfig(Config):
    strength: float = assumed(0.5, "tried by hand", ge=0.0)

class HabitsConfig(Config):
    updates: int = assumed(500, "enough", ge=1)
    operators: dict[str, tuple[float, ...]] = assumed({"laggy": (0.5,)}, "operators that are watched")
"""
STAGE = """
from outsider.settings import HabitsConfig

class HabitsStage:
    kind = "habits"
    config = HabitsConfig
    settings = ("action_repeat",)
    needs = ("dataset", "world_model")

    def run(self, job):
        return {"answer": 42}
"""
SPEC = """
name: outside
preset: smoke
tasks: [goal1]
methods: [human, nudge]
operators: {laggy: {mild: 0.5}}
seeds: [0]
"""


@pytest.fixture
def outsider(tmp_path, monkeypatch) -> Iterator[Path]:
    package = tmp_path / "site" / "outsider"
    package.mkdir(parents=True)
    files = {
        "__init__": "",
        "entries": REGISTERED,
        "settings": SETTINGS,
        "stage": STAGE,
        "method": "class Nudge: ...",
    }
    for name, text in files.items():
        (package / f"{name}.py").write_text(dedent(text), encoding="utf-8")
    info = package.with_name("outsider-1.0.dist-info")
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: outsider\nVersion: 1.0\n", encoding="utf-8"
    )
    (info / "entry_points.txt").write_text(ENTRIES, encoding="utf-8")
    (tmp_path / "outside.yaml").write_text(SPEC, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with installed(package.parent, "outsider"):
        yield package


def keys(*arguments: str) -> dict[str, str]:
    forget("outsider")
    done = run_here("plan", "outside.yaml", "--json", *arguments, columns=80, code=0)
    return {node["label"]: node["key"] for node in json.loads(done.stdout)["nodes"]}


def checked(code: int | None = None) -> Result:
    forget("outsider")
    return run_here("check", "outside.yaml", columns=400, code=code)


@pytest.mark.slow
def test_another_class_of_the_same_module_has_other_keys(outsider):
    before = keys()
    (outsider / "method.py").write_text("class Nudge: ...\nclass Shove: ...\n", encoding="utf-8")
    (outsider / "stage.py").write_text(
        dedent(STAGE) + "\n\nclass OtherStage(HabitsStage): ...\n", encoding="utf-8"
    )
    written = keys()
    moved = {label for label in before if before[label] != written[label]}
    (outsider / "entries.py").write_text(
        REGISTERED.replace("method:Nudge", "method:Shove"), encoding="utf-8"
    )
    method = keys()
    cells = {label for label in before if "nudge" in label}
    assert cells
    assert {label for label in before if method[label] != written[label]} == cells
    (outsider / "entries.py").write_text(
        REGISTERED.replace("stage:HabitsStage", "stage:OtherStage"), encoding="utf-8"
    )
    stage = keys()
    assert {label for label in before if stage[label] != written[label]} == moved


def test_its_section_has_values_of_presets_checks_and_a_schema(outsider):
    spec = outsider.parents[1] / "outside.yaml"
    for wrong, message in (
        (
            "habits: {updates: 0, operators: {lagy: [0.5]}}\n",
            "outside.yaml:8:19: should be greater than or equal to 1, not 0",
        ),
        (
            "stages: [habits]\nhabits: {operators: {lagy: [0.5]}}\n",
            "unknown operator variant 'lagy'",
        ),
    ):
        spec.write_text(SPEC + wrong, encoding="utf-8")
        assert message in checked(code=3).stderr
    (outsider / "method.py").write_text("class Nugde: ...", encoding="utf-8")
    assert "outside.yaml:5:18: the method 'nudge' of a plugin does not load" in checked().stderr
    (outsider / "method.py").write_text("class Nudge: ...", encoding="utf-8")
    spec.write_text(SPEC + "stages: [habits]\n", encoding="utf-8")
    assert checked().exit_code == 0
    assert any("habits" in label for label in keys())
    properties = spec_schema()["properties"]
    assert "habits" in properties
    assert "habits" in properties["stages"]["items"]["enum"]


@pytest.mark.parametrize(
    ("found", "put", "message"),
    [
        (
            'StageInfo("habits"',
            'StageInfo("tasks"',
            "the stage 'tasks' of a plugin has the name of a field of every spec",
        ),
        (
            'StageInfo("habits"',
            'StageInfo("ida"',
            "the stage 'ida' of a plugin has the name of a method",
        ),
        (
            'StageInfo("habits"',
            'StageInfo("Habits!"',
            "the stage name 'Habits!' should be small letters",
        ),
        ("presets=", 'unit="cell", presets=', "has unit 'cell'"),
        (
            "STAGE = StageInfo(",
            'STAGE = MethodInfo("a", "b", "c", "d")\nOTHER = StageInfo(',
            "is of type MethodInfo",
        ),
        ("outsider.stage:HabitsStage", "outsider.method:Nudge", "has no `config`"),
        (
            "outsider.stage:HabitsStage",
            "outsider.stage:Habits",
            "the stage 'habits' of a plugin does not load: AttributeError",
        ),
    ],
)
def test_what_cannot_be_a_stage_is_refused(outsider, found, put, message):
    assert found in REGISTERED
    (outsider / "entries.py").write_text(REGISTERED.replace(found, put), encoding="utf-8")
    assert message in " ".join(checked(code=1).stderr.split())


@pytest.mark.parametrize(
    ("found", "put", "message"),
    [
        (
            '("dataset", "world_model")',
            '("habits",)',
            "`needs` of stage 'habits' is not a tuple of names of other stages: ('habits',)",
        ),
        (
            '("dataset", "world_model")',
            '("dataset")',
            "`needs` of stage 'habits' is not a tuple of names of other stages: 'dataset'",
        ),
        (
            'settings = ("action_repeat",)',
            'settings = ("nope",)',
            "`settings` of stage 'habits' is not a tuple of names of fields of a spec",
        ),
        (
            'settings = ("action_repeat",)',
            "",
            "`settings` of stage 'habits' is not a tuple of names of fields of a spec: None",
        ),
    ],
)
def test_what_a_stage_says_of_itself_is_examined(outsider, found, put, message):
    (outsider / "stage.py").write_text(STAGE.replace(found, put), encoding="utf-8")
    assert message in " ".join(checked().stderr.split())


def test_a_variant_that_its_section_does_not_take_is_told_before_anything_runs(outsider):
    more = REGISTERED.replace(
        'needs=("habits",)', 'needs=("habits",), variants={"full": "full", "half": "half"}'
    )
    (outsider / "entries.py").write_text(more, encoding="utf-8")
    assert "unknown key 'variant'" in checked(code=3).stderr
