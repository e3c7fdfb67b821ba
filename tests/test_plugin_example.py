"""The package of docs/extending.md, as its author runs it: installed by pip, checked, planned,
run, reported and explained.
"""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands import ROOT, python, run_here
from tests.plugins import forget, installed

EXAMPLE = ROOT / "docs" / "examples" / "wasp_example"
PAGE = ROOT / "docs" / "extending.md"
SMALL = (
    "preset=smoke",
    "episodes=2",
    "stages=[]",
    "operators={sluggish: {moderate: 0.8}}",
    "expert.interactions=1000",
    "careful.limit=0.02",
)
"""Everything runs, nothing is learned; an untrained network warns of any command, so that the
assistant acts.
"""
CELL = "goal1 s0 careful sluggish=0.8"


class Home:
    """A folder with a copy of the package, the place where it is installed, and its spec."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.source, self.site = folder, folder / "source", folder / "site"
        shutil.copytree(EXAMPLE, self.source)
        shutil.copy(EXAMPLE / "careful.yaml", folder)
        offline = ("--no-index", "--no-deps", "--no-build-isolation", "--target", str(self.site))
        self.python("-m", "pip", "install", "--quiet", *offline, str(self.source))

    def python(self, *arguments: str) -> str:
        return python(self.folder, *arguments, path=(self.site,), code=0).stdout

    def wasp(self, *arguments: str, sets: tuple[str, ...] = ()) -> str:
        return self.python(
            "-m", "wasp_cli", *arguments, *(part for each in sets for part in ("--set", each))
        )

    def keys(self) -> dict[str, str]:
        forget("wasp_example")
        done = run_here(
            "plan",
            self.folder / "careful.yaml",
            "--results",
            self.folder / "results",
            "--json",
            columns=80,
            code=0,
        )
        return {node["label"]: node["key"] for node in json.loads(done.stdout)["nodes"]}


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Home:
    return Home(tmp_path_factory.mktemp("plugin"))


@pytest.fixture
def here(home) -> Iterator[Home]:
    """Installed for this process too."""
    with installed(home.site, "wasp_example"):
        yield home


def files() -> list[Path]:
    return sorted(
        path
        for path in EXAMPLE.rglob("*")
        if path.suffix in {".py", ".toml", ".yaml"} and path.name != "__init__.py"
    )


def blocks() -> list[tuple[str, str]]:
    """(language, text) of every block of the page that is a file."""
    return re.findall(
        r"^```(python|toml|yaml)\n(.*?)^```",
        PAGE.read_text(encoding="utf-8"),
        re.MULTILINE | re.DOTALL,
    )


def test_the_page_links_every_file_and_shows_them_as_they_are():
    text = PAGE.read_text(encoding="utf-8")
    assert [
        path.name
        for path in files()
        if f"]({path.relative_to(PAGE.parent).as_posix()})" not in text
    ] == []
    known = {
        path.read_text(encoding="utf-8") for path in [*files(), *EXAMPLE.parent.glob("halfway.*")]
    }
    assert {text for _, text in blocks()} <= known


@pytest.mark.slow
def test_its_own_tests_pass(home):
    assert " passed" in home.python(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", str(home.source / "tests")
    )


def test_its_spec_is_checked_and_keys_cover_what_its_nodes_run(here):
    spec = here.folder / "careful.yaml"
    assert "ok, 5 cells" in run_here("check", spec, columns=400).stdout
    wrong = run_here(
        "check",
        spec,
        "--set",
        "careful.limit=2",
        "--set",
        "operators.sluggish.wild=3",
        columns=400,
        code=3,
    )
    assert "careful.limit: should be less than 1" in wrong.stderr
    assert "should lie between 0 and 1 (weight of the last command)" in wrong.stderr
    before = here.keys()
    assert {"goal1 s0 risk", "goal1 s0 careful sluggish=0.8"} <= set(before)
    for file, old, new, moved in (
        ("entries.py", "Careful executes", "It executes", ""),
        ("assistant.py", "risk.argmin(1)", "risk.argmax(1)", "careful"),
        ("operator.py", "(1 - self.weight) * intended", "intended", "sluggish"),
        ("risk.py", "config.batch", "2 * config.batch", "risk|careful"),
    ):
        path = here.site / "wasp_example" / file
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")
        after = here.keys()
        path.write_text(text, encoding="utf-8")
        wanted = {label for label in before if moved and re.search(moved, label)}
        assert {label for label in before if before[label] != after[label]} == wanted, file


@pytest.mark.slow
def test_the_whole_chain_runs_and_every_command_knows_the_plugin(home):
    home.wasp("run", "careful.yaml", "-j", "2", sets=SMALL)
    printed = home.wasp("report", "results")
    assert re.search(r"Careful +\S+", printed)
    story = home.wasp("explain", CELL, "--episode", "0")
    assert re.search(r"operator +sluggish 0.8 \(weight of the last command\)", story)
    assert "Careful executes the least risky of the command" in story
    assert re.search(r"Careful +risk > 0.020 +\d+ +[1-9]", story)
    decision = home.wasp("explain", CELL, "--episode", "0", "--step", "0")
    assert "risk: the predicted probability that the command leads to cost" in decision
    plan = json.loads(home.wasp("plan", "careful.yaml", "--json", sets=SMALL))
    assert not [node["label"] for node in plan["nodes"] if node["state"] != "cached"]
