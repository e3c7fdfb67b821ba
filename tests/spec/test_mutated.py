"""Any text at all is a spec or a refusal with places; never another exception."""

import json
from pathlib import Path

import pytest
from hypothesis import given, settings

from tests.commands import run_here
from tests.spec.mutations import anything, lay_out_bases
from wasp_cli.plan.grid import cells_of
from wasp_cli.spec.load import load
from wasp_cli.spec.read import InvalidSpec, Problem, lines_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("mutated")
    lay_out_bases(path)
    return path


def problems(path: Path) -> tuple[Problem, ...]:
    try:
        list(cells_of(load(path).spec))
    except InvalidSpec as error:
        found = error.problems
    else:
        return ()
    assert found
    return found


def is_place(file: str, line: int | None, column: int | None) -> bool:
    path = Path(file)
    lines = lines_of(path.read_bytes().decode("utf-8-sig", errors="replace") if path.is_file() else "")
    return line is not None and column is not None and 1 <= line <= len(lines) and 1 <= column <= len(lines[line - 1]) + 1


def misplaced(path: Path) -> list[Problem]:
    """The problems of a spec that do not say where they are."""
    return [
        problem for problem in problems(path)
        if problem.position is None
        or not is_place(problem.source, problem.position.line, problem.position.column)
        or not str(problem).startswith(f"{path.parent}/")
    ]  # fmt: skip


def exit_code_of(path: Path) -> int:
    """`wasp check` itself, for people and for machines, which are told the same."""
    shown, told = run_here("check", path, columns=100), run_here("check", path, "--json", columns=100)
    assert shown.exit_code == told.exit_code
    assert (shown.stderr == "") == (shown.exit_code == 0)
    assert told.stderr == ""
    (entry,) = json.loads(told.stdout)
    assert entry["ok"] == (shown.exit_code == 0) == (not entry["problems"])
    for problem in entry["problems"]:
        assert is_place(problem["file"], problem["line"], problem["column"])
        assert f"{problem['file']}:{problem['line']}:{problem['column']}: " in shown.stderr
    return shown.exit_code


def written(folder: Path, text: str) -> Path:
    path = folder / "spec.yaml"
    path.write_bytes(text.encode())
    return path


@pytest.mark.filterwarnings("error")  # Python would print them behind the message
@settings(max_examples=200, deadline=None)
@given(text=anything())
def test_mutated_specs_are_specs_or_refusals_with_places(folder, text):
    assert misplaced(written(folder, text)) == []


@pytest.mark.filterwarnings("error")
@settings(max_examples=10, deadline=None)
@given(text=anything())
def test_the_command_ends_with_0_or_3(folder, text):
    assert exit_code_of(written(folder, text)) in (0, 3)
