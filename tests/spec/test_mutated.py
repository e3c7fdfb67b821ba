"""Any text at all is a spec or a refusal with places; never another exception."""

import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from tests.commands import ROOT, run_here
from wasp_cli.plan.grid import cells_of
from wasp_cli.spec.hints import settings
from wasp_cli.spec.load import load
from wasp_cli.spec.read import InvalidSpec, Problem, lines_of

SPECS = [
    path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "specs").glob("*.yaml"))
    if path.stem != "paper"
]
SNIPPETS = [
    "{",
    "}",
    "[",
    "]",
    ":",
    ": ",
    "- ",
    "#",
    "&a ",
    "*a",
    "<<: *a",
    "!!x ",
    "'",
    '"',
    "|",
    ">",
    "\n",
    "\n  ",
    "\t",
    "~",
    "null",
    "true",
    "1e999",
    ".nan",
    "-1",
    "0.5",
    "0x1f",
    "2020-01-01",
    "goal1",
    "wasp",
    "noisy",
    "? ",
    "%",
    "@",
    "\x00",
    "é",
    "\N{BOM}",
    "---\n",
    "...",
]
HUGE = "0x" + "f" * 5000
"""Python refuses to write it as a decimal."""
VALUES = [
    "null",
    "true",
    "yes",
    "0",
    "-1",
    "7",
    "0.5",
    "1e6",
    "1e999",
    ".nan",
    "-.inf",
    "0x1f",
    "0x_",
    "0o17",
    "'3'",
    "9" * 30,
    "9" * 4999,
    HUGE,
    "x",
    "''",
    "'a b'",
    '"\\ud800"',
    '"\\e[1m"',
    '"\\0"',
    "2020-01-01",
    "2020-13-45",
    "10:30",
    "!!binary aGk=",
    "!!set {a, b}",
    "!!omap [a: 1]",
    "!!int x",
    "!!float [1]",
    "!thing x",
    "!!str 3",
    "!!bool maybe",
    "[]",
    "{}",
    "[[]]",
    "[null]",
    "[x, 1]",
    "{a: 1}",
    "{a: {b: {c: 1}}}",
    "{1: 2, '1': 3}",
    "{~: 1}",
    "{true: 1}",
    "{[a]: b}",
    "{? {a: 1} : 2}",
    "{1.5: x}",
    "{.nan: 1}",
    "[goal1]",
    "[wasp, human]",
    "[no-case2]",
    "[expert, expert]",
    "{noisy: {mild: 0.2}}",
    "{noisy: 0.2}",
    "{mild: x}",
    "calibrated",
    "&b [1, *b]",
    "&m {<<: *m}",
    "&n {x: *n}",
    "|\n   text\n   more",
    "[" * 40 + "]" * 40,
    "[" * 700,
    "\N{LINE SEPARATOR}",
    "a\x85b",
    "goal1-v0",
    "a:b",
    "wasp/x",
    "..",
    "a.yaml",
    "absent.yaml",
]
"""YAML texts of values, right, wrong and odd."""
KEYS = [
    "zzz",
    "1",
    "true",
    "'a b'",
    "<<",
    "extends",
    "task",
    "? [x]",
    '"\\ud800"',
    "name",
    "noisy",
    "~",
    "*a",
    "!!x y",
    "2020-01-01",
    f"? {HUGE}\n",
]
EXTENDS = [
    "extends: base.yaml",
    "extends: broken.yaml",
    "extends: binary.yaml",
    "extends: absent.yaml",
    "extends: spec.yaml",
    "extends: loop.yaml",
    "extends: folder.yaml",
    "extends: long1.yaml",
    "extends: ..",
    "extends: base",
    "extends: [base.yaml]",
    "extends:",
    "extends: *a",
    "extends: !!x base.yaml",
    'extends: "base\\0.yaml"',
    "extend: base.yaml",
    "extends: {<<: *a}",
]
BASES: dict[str, str | bytes] = {
    "base.yaml": SPECS[0] + "wasp: {candidates: 8, feasable: 3}\n",
    "broken.yaml": "name: [\n",
    "binary.yaml": b"name: \xff\xfe",
    "loop.yaml": "name: loop\nextends: spec.yaml\n",
    **{
        f"long{number}.yaml": f"name: long\nextends: long{number + 1}.yaml\n"
        for number in range(1, 12)
    },
}
"""What the lines of `EXTENDS` name."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("mutated")
    for name, content in BASES.items():
        (path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (path / "folder.yaml").mkdir()
    return path


@st.composite
def characters(draw: st.DrawFn) -> str:
    """Some characters replaced by others."""
    text = draw(st.sampled_from(SPECS))
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.integers(0, 12)))
        text = text[:start] + draw(st.sampled_from(SNIPPETS) | st.text(max_size=4)) + text[end:]
    return text


@st.composite
def further_lines(draw: st.DrawFn) -> str:
    """A whole spec with lines of `extends` anywhere."""
    lines = draw(st.sampled_from(SPECS)).splitlines()
    for _ in range(draw(st.integers(1, 3))):
        lines.insert(
            draw(st.integers(0, len(lines))),
            draw(st.sampled_from(["", "", "", "  "])) + draw(st.sampled_from(EXTENDS)),
        )
    if draw(st.booleans()):
        missing = draw(st.sampled_from(["name", "tasks", "seeds", "methods"]))
        lines = [line for line in lines if not line.startswith(missing)]
    return "\n".join(lines) + "\n"


@st.composite
def other_values(draw: st.DrawFn) -> str:
    """A whole spec with other values of its settings, or with keys that are none."""
    text = draw(st.sampled_from(SPECS))
    for _ in range(draw(st.integers(1, 4))):
        top, *below = draw(st.sampled_from([*settings(), "operators.noisy.mild", *KEYS])).split(".")
        value = draw(st.sampled_from(VALUES))
        for part in reversed(below):
            value = f"{{{part}: {value}}}"
        text = re.sub(rf"(?m)^{re.escape(top)}:.*\n(?:[ #].*\n)*", "", text) + f"{top}: {value}\n"
    return text


ANYTHING = st.one_of(characters(), further_lines(), other_values(), st.text(max_size=60))


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
    lines = lines_of(
        path.read_bytes().decode("utf-8-sig", errors="replace") if path.is_file() else ""
    )
    return (
        line is not None
        and column is not None
        and 1 <= line <= len(lines)
        and 1 <= column <= len(lines[line - 1]) + 1
    )


def misplaced(path: Path) -> list[Problem]:
    """The problems of a spec that do not say where they are."""
    return [
        problem
        for problem in problems(path)
        if problem.position is None
        or not is_place(problem.source, problem.position.line, problem.position.column)
        or not str(problem).startswith(f"{path.parent}/")
    ]


def exit_code_of(path: Path) -> int:
    """`wasp check` itself, for people and for machines, which are told the same."""
    shown, told = (
        run_here("check", path, columns=100),
        run_here("check", path, "--json", columns=100),
    )
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
@examples(max_examples=80, deadline=None)
@given(text=ANYTHING)
def test_mutated_specs_are_specs_or_refusals_with_places(folder, text):
    assert misplaced(written(folder, text)) == []


@pytest.mark.filterwarnings("error")
@examples(max_examples=10, deadline=None)
@given(text=ANYTHING)
def test_the_command_ends_with_0_or_3(folder, text):
    assert exit_code_of(written(folder, text)) in (0, 3)
