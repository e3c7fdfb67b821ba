"""An assistant in one file, as a user runs it: `module:Class` in a spec, and `wasp run`."""

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.commands import ROOT, python, wasp

EXAMPLES = ROOT / "docs" / "examples"
NAME = "halfway:Halfway"


@pytest.fixture
def home(tmp_path) -> Path:
    for name in ("halfway.py", "halfway.yaml"):
        shutil.copy(EXAMPLES / name, tmp_path)
    return tmp_path


def nodes(home: Path) -> dict[str, dict[str, str]]:
    done = wasp(home, "plan", "halfway.yaml", "--json", code=0)
    return {node["label"]: node for node in json.loads(done.stdout)["nodes"]}


@pytest.mark.slow
def test_it_stands_beside_wasp_on_published_worlds(home):
    before = nodes(home)
    own = {label for label in before if NAME in label}
    assert {
        label
        for label, node in before.items()
        if node["state"] == "missing" and node["kind"] == "evaluate"
    } == own
    done = wasp(
        home,
        "run",
        "halfway.yaml",
        "-j",
        "0",
        "--limit",
        "2",
        "--select",
        f"method={NAME},operator=laggy",
        code=0,
    )
    assert "Halfway" in done.stdout
    # Results are read without importing what they name.
    text = (home / "halfway.py").read_text(encoding="utf-8")
    (home / "halfway.py").write_text("open('imported', 'w')\n1 / 0\n", encoding="utf-8")
    for command in (
        ["explain", f"goal1 s313 {NAME} laggy=0.7", "--episode", "0"],
        ["report", "results", "--no-trained"],
    ):
        assert (
            "Halfway is a class of the module halfway" if command[0] == "explain" else "Halfway"
        ) in wasp(home, *command, code=0).stdout
    assert not (home / "imported").exists()
    # A changed constant is another assistant, and nobody else's cell.
    (home / "halfway.py").write_text(text.replace("> 0.7", "> 0.5"), encoding="utf-8")
    changed = {label for label, node in nodes(home).items() if node["key"] != before[label]["key"]}
    assert changed == own


MISTAKES = {
    "1 / 0\n": "module 'halfway' does not import: ZeroDivisionError: division by zero",
    "import absent_library\n": "install 'absent_library', which it imports",
    "class Other: ...\n": "the assistant 'halfway:Halfway' is not in "
    "<module 'halfway' from '{home}/halfway.py'>",
    "class Halfway:\n    def reset(self, rows, "
    "seeds): ...\n": "the assistant 'halfway:Halfway' has no decide",
    "class Halfway:\n    needs = 'critics'\n    reset "
    "= decide = print\n": "`needs` of 'halfway:Halfway' is 'critics', no tuple of stages",
    None: "module 'halfway' does not import: ModuleNotFoundError",
}
CHECK = """
import sys
from wasp_cli.cli import main

for source in %r:
    sys.modules.pop("halfway", None)
    if source:
        open("halfway.py", "w").write(source)
    else:
        __import__("os").remove("halfway.py")
        sys.path_importer_cache.clear()
    sys.argv = ["wasp", "check", "halfway.yaml"]
    try:
        main()
    except SystemExit as end:
        print(end.code, file=sys.stderr)
"""


def test_mistakes_in_it_are_shown_where_the_spec_names_it(home):
    done = python(home, "-B", "-c", CHECK % list(MISTAKES), code=0)
    told = re.split(r"^3$\n?", done.stderr, flags=re.MULTILINE)
    assert len(told) == 1 + len(MISTAKES)
    for message, shown in zip(MISTAKES.values(), told[:-1], strict=True):
        assert "halfway.yaml:4:23: " in shown
        assert message.format(home=home) in shown
        assert "Traceback" not in shown
