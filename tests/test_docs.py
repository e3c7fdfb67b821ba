"""The commands that the documentation shows exist, with the options that it shows."""

import csv
import json
import re
import shlex
import shutil
from dataclasses import fields
from pathlib import Path
from statistics import mean
from typing import Any

import pytest
import typer
from PIL import Image
from ruamel.yaml import YAML

import wasp_cli
from tests.commands import ROOT, run_here
from wasp_cli.cli import app
from wasp_cli.cli.options import SelectedSpec
from wasp_cli.drive.prepare import shipped
from wasp_cli.learning.configs import ExpertConfig
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.plan import Plan
from wasp_cli.plan.planned import planned
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.run.session import planned_sweep
from wasp_cli.spec.load import ablation, load, read_sweep, sized
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.registry import TASKS

PUBLISHED = ROOT / "results" / "published"
PLUGIN = "extending.md"
"""Its spec needs the package that it shows: see test_plugin_example.py."""
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def shown() -> list[tuple[str, str, str]]:
    """(page, folder, command line) of every `$ wasp ...`; a block begins in the root, and `$ cd
    FOLDER` leaves it.
    """
    found = []
    for page in PAGES:
        for block in blocks(page, "console"):
            folder = "."
            for line in block.splitlines():
                if line.startswith("$ cd "):
                    folder = line.removeprefix("$ cd ").strip()
                elif line.startswith("$ "):
                    commands = line[2:].partition("  #")[0].split(" && ")
                    found += [
                        (page.name, folder, command.strip())
                        for command in commands
                        if command.startswith("wasp")
                    ]
    return found


def parse(line: str) -> dict[str, Any]:
    """Parse a command line as `wasp` would, without running it."""
    name, *arguments = shlex.split(line)[1:]
    group: Any = typer.main.get_command(app)
    assert name in group.commands, f"no command '{name}'"
    with group.commands[name].make_context(name, arguments) as context:
        parameters: dict[str, Any] = context.params
        return parameters


@pytest.mark.parametrize(("page", "folder", "line"), shown(), ids=lambda part: part)
def test_shown_commands_parse(page, folder, line):
    parameters = parse(line)
    if shlex.split(line)[1] == "ablate":
        arguments = (
            parameters["variant"],
            parameters["task"],
            parameters["preset"],
            parameters["set_"] or (),
        )
        assert ablation(ROOT / parameters["spec"], *arguments)
    elif shlex.split(line)[1] == "sweep":
        (vary,) = parameters["vary"]
        assert read_sweep(
            ROOT / folder / parameters["spec"],
            vary,
            parameters["method"] or (),
            parameters["set_"] or (),
        )
    elif shlex.split(line)[1] == "drive" and parameters["what"] in TASKS:
        assert shipped(
            parameters["what"],
            ["wasp"],
            parameters["participant"] or 0,
            [0],
            parameters["preset"],
            parameters["set_"] or (),
        )
    elif parameters.get("set_"):
        assert load(ROOT / folder / parameters["spec"], parameters["set_"])
    read = [value for name, value in parameters.items() if name != "write"]
    for value in read:
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, Path) and path.suffix == ".yaml":
                assert (ROOT / folder / path).is_file(), f"{page} shows {path}, which is not there"


LONG = (
    "wasp run specs/worldmodel.yaml --task goal1",
    "wasp sweep specs/quickstart.yaml --vary action_repeat=2,4 --method human --method ida --json",
)
"""Shown commands that train at full size, which takes an hour and more: learning.md and guide.md
say so.
"""


def examples() -> list[str]:
    """Every command line of pages and of `--help` that computes cells of a shipped spec."""
    commands: Any = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    helped = [
        re.split(r" [|>] ", line)[0]
        for command in commands.values()
        for line in re.findall(r"\[bold\](.*?)\[/\]", command.epilog)
    ]
    found = []
    for line in dict.fromkeys([*(line for _, _, line in shown()), *helped]):
        name, first = line.split()[1:3] if line.count(" ") > 1 else ("", "")
        of_spec = name in ("run", "sweep") and (ROOT / first).is_file()
        if of_spec or name == "ablate":
            found.append(line)
    return found


def planned_by(line: str, results: Path) -> Plan:
    """The plan of a command line in an empty results folder."""
    given, name = parse(line), line.split()[1]
    if name == "ablate":
        variant, task, preset, set_ = (given[key] for key in ("variant", "task", "preset", "set_"))
        loaded = ablation(ROOT / given["spec"], variant, task, preset, set_ or ())
        return planned(loaded, results, reuse=given["reuse"])
    if name == "sweep":
        settings = sized(given["preset"], given["set_"])
        swept = read_sweep(
            ROOT / given["spec"], given["vary"][0], given["method"] or (), settings, given["task"]
        )
        return planned_sweep(swept, Layout(results), given["reuse"])
    names = [part.name for part in fields(SelectedSpec)]
    asked = SelectedSpec(**{key: given[key] for key in names} | {"spec": ROOT / given["spec"]})
    return planned(asked.load(), results, asked.select or (), asked.reuse)


@pytest.mark.slow  # a plan of each
@pytest.mark.parametrize("line", examples())
def test_no_shown_command_trains_at_full_size_unless_its_page_says_how_long_that_takes(
    line, tmp_path
):
    plan = planned_by(line, tmp_path / "results")
    trained = [
        node.label
        for node in plan.to_run()
        if node.kind == "expert" and node.config["interactions"] >= ExpertConfig().interactions
    ]
    assert bool(trained) == (line in LONG), trained


@pytest.mark.parametrize(
    "text",
    [
        text
        for page in PAGES
        if page.name != PLUGIN
        for text in blocks(page, "yaml")
        if text.startswith(("name:", "extends:"))
    ],
)
def test_shown_specs_are_valid(text, tmp_path):
    shutil.copytree(ROOT / "specs", tmp_path, dirs_exist_ok=True)  # which they may extend
    (tmp_path / "spec.yaml").write_text(text, encoding="utf-8")
    assert load(tmp_path / "spec.yaml").spec.tasks


@pytest.mark.parametrize(
    ("page", "name"),
    [
        ("extending.md", "halfway.py"),
        ("extending.md", "halfway.yaml"),
        ("own_task.md", "puddle.py"),
        ("own_task.md", "puddle.yaml"),
    ],
)
def test_pages_show_the_files_of_examples_as_they_are(page, name):
    language = "python" if name.endswith(".py") else "yaml"
    assert (ROOT / "docs/examples" / name).read_text(encoding="utf-8") in blocks(
        ROOT / "docs" / page, language
    )


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CHANGELOG.md", ROOT / "REPRODUCTION.md"], ids=lambda page: page.name
)
def test_links_and_pictures_lead_somewhere_and_no_gap_is_left_to_fill(page):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"^[A-Z_]{5,}$", text, re.MULTILINE)
    for link, picture in re.findall(r"\]\(([^)#:]+)\)|<img src=\"([^\"]+)\"", text):
        assert (page.parent / (link or picture)).exists(), f"{page.name} links to {link or picture}"


def test_the_quickstart_names_what_is_published_of_its_cells() -> None:
    spec, layout = (
        load(ROOT / "specs/table1.yaml", ["tasks=[goal1]", "seeds=[1]"]).spec,
        Layout(Path("absent")),
    )
    keys = {
        node.key: METHODS[cell.method].title
        for cell, node in lay_out_over(spec, layout, str(PUBLISHED)).cells
    }
    rows = wasp_cli.results(PUBLISHED).episodes(key=[*keys]).to_pylist()
    for method, (*_, published) in quickstart_rows().items():
        episodes = [row for row in rows if keys[row["key"]] == method]
        assert len(episodes) == (30 if method == "Expert" else 120)
        assert published == " / ".join(
            f"{mean(row[name] for row in episodes):.1f}" for name in ("return", "cost")
        )


@pytest.mark.slow
def test_the_quickstart_prints_its_table(tmp_path: Path) -> None:
    assert (
        "Goal1: the operators alone return"
        in run_here("run", "quickstart", "--results", tmp_path, columns=200, code=0).stdout
    )
    table = (tmp_path / "reports/quickstart/table1.csv").read_text(encoding="utf-8").splitlines()
    printed = {row["method"]: row for row in csv.DictReader(table)}
    for method, (returned, *_) in quickstart_rows().items():
        assert float(printed[method]["return"]) == pytest.approx(float(returned), abs=1.5), (
            "processors round differently"
        )
    costs = {method: float(printed[method]["cost"]) for method in ("Human-only", "IDA", "WASP")}
    assert costs["WASP"] < costs["IDA"] < costs["Human-only"], (
        "few episodes have most of it, so that its size says little"
    )


def quickstart_rows() -> dict[str, list[str]]:
    lines = (ROOT / "docs/quickstart.md").read_text(encoding="utf-8").splitlines()
    rows = [
        line[2:-2].split(" | ")
        for line in lines
        if line.startswith("| ") and line.count(" | ") == 7
    ][2:]
    assert len(rows) == 8
    return {name.removesuffix(" (reference)"): numbers for name, *numbers in rows}


def test_the_chain_of_concepts_has_the_order_of_what_stages_need():
    chain, _, below = blocks(ROOT / "docs/concepts.md", "")[0].splitlines()
    kinds = [word.strip(" -+").replace("-", "").replace(" ", "_") for word in chain.split("-->")]
    assert all(set(STAGES.load(kind).needs) <= set(kinds[:i]) for i, kind in enumerate(kinds))
    assert chain.index("held-out") <= below.index("+-->") < chain.index("critics"), (
        "IDA's ensemble is judged on held-out episodes"
    )


def test_contributing_names_what_keys_cover():
    named = (
        (ROOT / "CONTRIBUTING.md")
        .read_text(encoding="utf-8")
        .partition("A change in")[2]
        .partition("can change keys")[0]
    )
    manifests = [
        json.loads(path.read_text()) for path in PUBLISHED.glob("store/*/*/_manifest.json")
    ]
    modules = {module for each in manifests for module in each["sources"]}
    rooms = {module.split(".")[1] for module in modules if module.startswith("wasp_cli.")}
    assert set(re.findall(r"`(\w+)`", named)) == rooms


def test_the_film_of_the_readme_moves_and_is_small():
    (name,) = re.findall(
        r"\]\((docs/pictures/[^)]+\.webp)\)", (ROOT / "README.md").read_text(encoding="utf-8")
    )
    assert (ROOT / name).stat().st_size < 1.5e6
    with Image.open(ROOT / name) as film:
        assert film.format == "WEBP"
        assert film.n_frames > 10


def test_the_readme_names_the_command_that_the_check_of_a_change_runs():
    (start, *_) = blocks(ROOT / "README.md", "console")
    tests = start.splitlines()[-1].removeprefix("$ ")
    script = (ROOT / ".ci/run").read_text(encoding="utf-8").splitlines()
    assert script[-1] == tests
    assert "nox" in tests


def test_every_page_is_in_the_navigation_of_the_site_once():
    contents = YAML(typ="safe").load(ROOT / "docs/site/toc.yml")
    listed = [contents["root"]]
    for group in contents["subtrees"]:
        listed += [entry["file"] for entry in group["entries"]]
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    pages += [*(ROOT / "docs/examples").glob("*.ipynb")]
    assert sorted(listed) == sorted(
        path.relative_to(ROOT).with_suffix("").as_posix() for path in pages
    )
