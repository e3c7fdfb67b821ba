"""`wasp compare` from outside."""

import json
import shutil
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.compare.two_runs import episodes, write_results
from wasp_cli.report.render import RENDERERS


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds `one`, its copy `two`, `other` under another spec's name and with more cost, and `empty`."""
    path = tmp_path_factory.mktemp("folders")
    write_results(path / "one", lambda identity: episodes(identity, count=10))
    shutil.copytree(path / "one", path / "two")
    write_results(path / "other", lambda identity: episodes(identity, count=10, risk=0.9), name="mine")
    (path / "empty").mkdir()
    return path


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_copy_is_alike(folder: Path) -> None:
    before = snapshot(folder)
    done = run_here("compare", folder / "one", folder / "two", "--strict", columns=120)
    assert (done.exit_code, done.stderr) == (0, "")
    assert "8 cells: 8 the same; none differ by more than noise." in done.stdout
    assert snapshot(folder) == before


def test_two_named_specs_are_compared_and_strict_tells_by_its_exit_code(folder: Path) -> None:
    arguments = ("compare", folder / "one", folder / "other", "--spec-a", "tiny", "--spec-b", "mine")
    done = run_here(*arguments, columns=120)
    assert done.exit_code == 0
    assert "8 cells: 8 other rows; 8 differ by more than noise." in done.stdout
    assert "Cells that differ" in done.stdout
    assert "Difference of each assistant" in done.stdout
    strict = run_here(*arguments, "--strict", columns=120)
    assert (strict.exit_code, strict.stdout) == (1, done.stdout)
    assert "not alike: tiny" in strict.stderr


def test_json_is_all_of_stdout(folder: Path) -> None:
    done = run_here("compare", folder / "one", folder / "two", "--json", columns=120)
    (facts,) = json.loads(done.stdout)
    assert (facts["alike"], len(facts["cells"]), facts["first"]["spec"]) == (True, 8, "tiny")


def test_out_writes_every_table_in_every_format(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    done = run_here("compare", folder / "one", folder / "other", "--spec-a", "tiny", "--spec-b", "mine", "--out", out, columns=120)
    assert done.exit_code == 0
    assert str(out / "compare.md") in done.stdout
    tables = {f"tiny-{name}.{ending}" for name in ("cells", "summary") for ending in RENDERERS}
    assert {path.name for path in out.iterdir()} == {"compare.md", *tables}


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("one", "absent"), "no such folder"),
        (("empty", "one"), "it holds no runs"),
        (("one", "other"), "no spec has run in both folders"),
        (("one", "two", "--spec", "tinny"), "did you mean 'tiny'?"),
        (("one", "other", "--spec-a", "tiny"), "need each other"),
        (("one", "other", "--spec-a", "tiny", "--spec-b", "mein"), "did you mean 'mine'?"),
        (("one", "other", "--spec", "tiny", "--spec-b", "mine"), "need each other"),
        (("one", ""), "the name of the folder is empty"),
        (("one", "two", "--out", __file__), "is not a folder"),
    ],
)
def test_what_cannot_be_compared_ends_with_2(folder: Path, arguments: tuple[str, ...], what: str) -> None:
    named = [str(folder / each) if each in ("one", "two", "other", "empty", "absent") else each for each in arguments]
    done = run_here("compare", *named, columns=200)
    assert done.exit_code == 2
    assert what in " ".join(done.stderr.split())
    assert "Traceback" not in done.output


def test_a_damaged_plan_ends_with_2(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "one", tmp_path / "damaged")
    (plan,) = (tmp_path / "damaged" / "runs").glob("*/plan.json")
    plan.write_text('{"spec": "tiny", "cells": 7}')
    done = run_here("compare", folder / "one", tmp_path / "damaged", columns=200)
    assert done.exit_code == 2
    assert "cannot read the plan of run" in done.stderr
