"""An assistant in one file, as a user runs it: `module:Class` in a spec, and `wasp run`."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs" / "examples"
NAME = "halfway:Halfway"


def wasp(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `wasp` as its console script does: with `-P`, Python does not search the current folder by itself."""
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1", "COLUMNS": "160"}
    command = [sys.executable, "-P", "-m", "wasp_cli", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, env=variables, check=False)


@pytest.fixture
def home(tmp_path) -> Path:
    for name in ("halfway.py", "halfway.yaml"):
        shutil.copy(EXAMPLES / name, tmp_path)
    return tmp_path


def test_the_page_shows_both_files_as_they_are():
    page = (EXAMPLES.parent / "extending.md").read_text(encoding="utf-8")
    for name, language in (("halfway.py", "python"), ("halfway.yaml", "yaml")):
        assert f"```{language}\n{(EXAMPLES / name).read_text(encoding='utf-8')}```" in page


def nodes(home: Path) -> dict[str, dict[str, str]]:
    done = wasp(home, "plan", "halfway.yaml", "--json")
    assert done.returncode == 0, done.stderr
    return {node["label"]: node for node in json.loads(done.stdout)["nodes"]}


def test_it_stands_beside_wasp_on_published_worlds(home):
    before = nodes(home)
    own = {label for label in before if NAME in label}
    assert {label for label, node in before.items() if node["state"] == "missing" and node["kind"] == "evaluate"} == own
    done = wasp(home, "run", "halfway.yaml", "-j", "0", "--select", f"method={NAME},operator=laggy")
    assert done.returncode == 0, done.stderr
    assert "Halfway" in done.stdout
    after = wasp(home, "explain", f"goal1 s313 {NAME} laggy=0.7", "--episode", "0")
    assert after.returncode == 0, after.stderr
    assert "Halfway is a class of the module halfway" in after.stdout
    # Results are read without importing what they name.
    text = (home / "halfway.py").read_text(encoding="utf-8")
    (home / "halfway.py").write_text("open('imported', 'w')\n1 / 0\n", encoding="utf-8")
    for command in (["explain", f"goal1 s313 {NAME} laggy=0.7", "--episode", "0"], ["report", "results", "--no-films", "--no-trained"]):
        read = wasp(home, *command)
        assert read.returncode == 0, read.stderr
        assert "Halfway" in read.stdout
    assert not (home / "imported").exists()
    # A changed constant is another assistant, and nobody else's cell.
    (home / "halfway.py").write_text(text.replace("> 0.7", "> 0.5"), encoding="utf-8")
    changed = {label for label, node in nodes(home).items() if node["key"] != before[label]["key"]}
    assert changed == own


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "module 'halfway' does not import: ModuleNotFoundError"),
        ("1 / 0\n", "module 'halfway' does not import: ZeroDivisionError: division by zero"),
        ("class Other: ...\n", "the assistant 'halfway:Halfway' is not there"),
        ("class Halfway:\n    def reset(self, rows, seeds): ...\n", "the assistant 'halfway:Halfway' has no decide"),
    ],
)
def test_mistakes_in_it_are_shown_where_the_spec_names_it(home, source, message):
    (home / "halfway.py").unlink()
    if source is not None:
        (home / "halfway.py").write_text(source, encoding="utf-8")
    done = wasp(home, "check", "halfway.yaml")
    assert done.returncode == 3
    assert "halfway.yaml:4:23: " in done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
