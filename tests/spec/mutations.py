"""Specs with mistakes of all kinds, for tests of how they are refused."""

import io
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from ruamel.yaml import YAML

from wasp_cli.spec.hints import settings

FOLDER = Path(__file__).parents[2] / "specs"
SPECS = [path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.yaml")) if path.stem != "paper"]
SNIPPETS = [
    "{", "}", "[", "]", ":", ": ", "- ", "#", "&a ", "*a", "<<: *a", "!!x ", "'", '"', "|", ">", "\n", "\n  ", "\t", "~", "null", "true",
    "1e999", ".nan", "-1", "0.5", "0x1f", "2020-01-01", "goal1", "wasp", "noisy", "? ", "%", "@", "\x00", "é", "\N{BOM}", "---\n", "...",
]  # fmt: skip
HUGE = "0x" + "f" * 5000
"""Python refuses to write it as a decimal."""
VALUES = [
    "null", "true", "yes", "0", "-1", "7", "0.5", "1e6", "1e999", ".nan", "-.inf", "0x1f", "0x_", "0o17", "'3'", "9" * 30, "9" * 4999,
    HUGE, "x", "''", "'a b'", '"\\ud800"', '"\\e[1m"', '"\\0"', "2020-01-01", "2020-13-45", "10:30", "!!binary aGk=",
    "!!set {a, b}", "!!omap [a: 1]", "!!int x", "!!float [1]", "!thing x", "!!str 3", "!!bool maybe", "[]", "{}", "[[]]", "[null]",
    "[x, 1]",
    "{a: 1}", "{a: {b: {c: 1}}}", "{1: 2, '1': 3}", "{~: 1}", "{true: 1}", "{[a]: b}", "{? {a: 1} : 2}", "{1.5: x}", "{.nan: 1}",
    "[goal1]", "[wasp, human]", "[no-case2]", "[expert, expert]", "{noisy: {mild: 0.2}}", "{noisy: 0.2}", "{mild: x}", "calibrated",
    "&b [1, *b]", "&m {<<: *m}", "&n {x: *n}", "|\n   text\n   more", "[" * 40 + "]" * 40, "[" * 700, "\N{LINE SEPARATOR}", "a\x85b",
    "goal1-v0", "a:b", "wasp/x", "..", "a.yaml", "absent.yaml",
]  # fmt: skip
"""YAML texts of values, right, wrong and odd."""
KEYS = [
    "zzz", "1", "true", "'a b'", "<<", "extends", "task", "? [x]", '"\\ud800"', "name", "noisy", "~", "*a", "!!x y", "2020-01-01",
    f"? {HUGE}\n",
]  # fmt: skip
EXTENDS = [
    "extends: base.yaml", "extends: broken.yaml", "extends: binary.yaml", "extends: absent.yaml", "extends: spec.yaml",
    "extends: loop.yaml",
    "extends: folder.yaml", "extends: long1.yaml", "extends: ..", "extends: base", "extends: [base.yaml]", "extends:", "extends: *a",
    "extends: !!x base.yaml", 'extends: "base\\0.yaml"', "extend: base.yaml", "extends: {<<: *a}",
]  # fmt: skip
BASES: dict[str, str | bytes] = {
    "base.yaml": SPECS[0] + "wasp: {candidates: 8, feasable: 3}\n",
    "broken.yaml": "name: [\n",
    "binary.yaml": b"name: \xff\xfe",
    "loop.yaml": "name: loop\nextends: spec.yaml\n",
    **{f"long{number}.yaml": f"name: long\nextends: long{number + 1}.yaml\n" for number in range(1, 12)},
}
"""What the lines of `EXTENDS` name."""


def lay_out_bases(folder: Path) -> None:
    for name, content in BASES.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "folder.yaml").mkdir()


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
        lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(["", "", "", "  "])) + draw(st.sampled_from(EXTENDS)))
    if draw(st.booleans()):
        missing = draw(st.sampled_from(["name", "tasks", "seeds", "methods"]))
        lines = [line for line in lines if not line.startswith(missing)]
    return "\n".join(lines) + "\n"


@st.composite
def replaced_values(draw: st.DrawFn) -> str:
    """The parsed document with other values at some of its places, and with settings that it did not have."""
    document: dict[str, Any] = YAML(typ="safe").load(draw(st.sampled_from(SPECS)))
    for setting in draw(st.lists(st.sampled_from(settings()), max_size=3)):
        node = document
        *above, last = setting.split(".")
        for part in above:
            below = node.get(part)
            node[part] = node = below if isinstance(below, dict) else {}
        node[last] = 0
    marks: dict[str, str] = {}
    for _ in range(draw(st.integers(1, 4))):
        change(draw, document, marks)
    written = io.StringIO()
    writer = YAML()
    writer.width = 10_000
    writer.dump(document, written)
    text = written.getvalue()
    for mark, value in marks.items():
        text = text.replace(mark, value)
    return text


def change(draw: st.DrawFn, document: dict[str, Any], marks: dict[str, str]) -> None:
    """Put a mark at a place of a document, as a value or as a key; `marks` says which text is meant."""
    node: Any = document
    while True:
        keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            return
        key = draw(st.sampled_from(keys))
        if not isinstance(node[key], dict | list) or draw(st.booleans()):
            break
        node = node[key]
    mark = f"MARK{len(marks)}X"
    if isinstance(node, dict) and draw(st.integers(0, 4)) == 0:
        marks[mark] = draw(st.sampled_from(KEYS))
        node[mark] = node.pop(key)
    else:
        marks[mark] = draw(st.sampled_from(VALUES))
        node[key] = mark


def anything() -> st.SearchStrategy[str]:
    return st.one_of(characters(), further_lines(), replaced_values(), st.text(max_size=60))
