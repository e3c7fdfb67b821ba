"""The tables of environments that others wrote: docs/environments.md shows what is published."""

import json
import tomllib
from pathlib import Path

import away
import pytest
import yaml

from tests.test_docs import blocks
from wasp_cli.cells.table import paired

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "specs" / "away"
DOCS = ROOT / "docs"
PAGE = (DOCS / "environments.md").read_text(encoding="utf-8")
# kinds of artifacts with weights
MODELS = ("critics", "denoiser", "expert", "ida_q", "policies", "world_model")
PUBLISHED = [task for task in away.TASKS if len(away.cells_of(task))]
TRAININGS = {"LunarLander": 3, "PointMaze": 3}  # 1 of the others


@pytest.mark.parametrize("task", PUBLISHED)
def test_the_page_shows_the_tables_of_the_published_rows(task):
    for part in away.report(task).split("\n\n"):
        assert part in PAGE


@pytest.mark.parametrize("task", PUBLISHED)
def test_every_method_met_the_same_worlds_under_every_operator(task):
    worlds = {}
    for method in away.METHODS:
        worlds[method] = set()
        own = away.of_method(away.cells_of(task), method)
        for place, cell in enumerate(own):
            of_cell = own.choose([place]).worlds.tolist()
            worlds[method].update((cell.operator, cell.seed, world) for world in of_cell)
    del worlds["expert"]
    assert all(len(each) == 120 * TRAININGS.get(task, 1) for each in worlds.values())
    assert len(set(map(frozenset, worlds.values()))) == 1


def test_the_spec_of_all_environments_has_what_the_single_ones_have():
    def read(path):
        return yaml.safe_load(path.read_text(encoding="utf-8"))

    whole = read(FOLDER / "away.yaml")
    by_task = whole.pop("by_task")
    tasks = []
    for path in FOLDER.glob("*.yaml"):
        if path.name == "away.yaml":
            continue
        single = read(path)
        (task,) = single.pop("tasks")
        tasks.append(task)
        assert single.pop("expert", None) == by_task.get(task["name"], {}).get("expert")
        assert {**single, "name": "away"} == {
            name: value for name, value in whole.items() if name != "tasks"
        }
    assert sorted(tasks, key=str) == sorted(whole["tasks"], key=str)


def test_the_page_shows_the_declarations_and_the_functions_as_they_are():
    declared = {}
    for path in FOLDER.glob("*.yaml"):
        for task in yaml.safe_load(path.read_text(encoding="utf-8"))["tasks"]:
            declared[task["name"]] = task
    shown = [yaml.safe_load(block)[0] for block in blocks(DOCS / "environments.md", "yaml")]
    assert {task["name"]: task for task in shown} == declared

    costs = (FOLDER / "costs.py").read_text(encoding="utf-8")
    functions = blocks(DOCS / "environments.md", "python")[:-1]  # the last one is a loop
    assert len(functions) == 4
    assert all(function in costs for function in functions)


def test_the_loop_of_the_page_lands(monkeypatch):
    pytest.importorskip("Box2D")
    (loop,) = [
        block for block in blocks(DOCS / "environments.md", "python") if "LunarLander s0" in block
    ]
    monkeypatch.chdir(ROOT)
    names: dict[str, float] = {}
    exec(loop, names)
    assert names["total"] > 200


def test_the_wheel_leaves_out_the_models_of_environments_of_others():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    left_out = set(settings["tool"]["hatch"]["build"]["targets"]["wheel"]["exclude"])
    models = set()
    for kind in MODELS:
        for manifest in (ROOT / "results/published/store" / kind).glob("*/_manifest.json"):
            if json.loads(manifest.read_text(encoding="utf-8"))["task"] in away.TASKS:
                models.add(manifest.parent.relative_to(ROOT).as_posix())
    assert models
    assert {path for path in left_out if path.startswith("results/published/store/")} == models


def test_no_published_environment_is_left_out():
    assert list(away.TASKS) == PUBLISHED


def test_an_unpublished_task_has_no_table(tmp_path):
    assert away.report("Nowhere") is None


def test_differences_are_paired_by_world():
    wasp, human = (
        away.of_method(away.cells_of("LunarLander"), method) for method in ("wasp", "human")
    )
    assert away.with_interval(wasp, wasp, "cost") == "+0.00 [0.00, 0.00]"
    own, other = paired(wasp, human, "return")
    assert own.worlds.tolist() == other.worlds.tolist()
    mean = (own.episodes("return") - other.episodes("return")).mean()
    assert away.with_interval(wasp, human, "return").startswith(f"{mean:+.2f} ")


def test_the_readme_shows_returns_and_costs_of_the_published_rows():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    tables = {}
    for task in PUBLISHED:
        cells = away.cells_of(task)
        place = away.heading(cells).index("Cost/1000 ↓") + 1
        rows = away.table(cells, spread=False)
        tables[task] = {row[0]: f"{row[1]} / {row[place]}" for row in rows}
    for method in away.METHODS.values():
        assert f"| {method} | {' | '.join(tables[task][method] for task in PUBLISHED)} |" in readme
