import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.report.render import ACCENTS, SPECIAL, escaped, latex
from wasp_cli.report.summary import Value
from wasp_cli.report.tables.table import Column, Row, Table

NASTY = '50% of $x_1$ & #2 {a} ~ ^ \\input{/etc/passwd} [b] *c* <d> |e| "f" `g\' -- é ł \u202e\n% new line τ²'
LITERAL = {text: character for character, text in SPECIAL.items() if ord(character) < 128 and character != '"'}
TOKENS = re.compile("|".join(map(re.escape, sorted(LITERAL, key=len, reverse=True))) + r"|(?P<joined>[-,'`]\{\})|.", re.DOTALL)


def read(text: str) -> str:
    """What LaTeX prints of escaped ASCII text without quotation marks."""
    return "".join(each[0][0] if each["joined"] else LITERAL.get(each[0], each[0]) for each in TOKENS.finditer(text))


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126, exclude_characters='"')))
def test_ascii_is_printed_as_it_is(text: str) -> None:
    assert read(escaped(text)) == " ".join(text.split())


@given(st.text())
def test_text_is_one_line_of_ascii_and_nothing_in_it_is_a_command_of_its_own(text: str) -> None:
    found = escaped(text)
    assert found.isascii()
    assert found.isprintable()
    bare = re.sub(r"\\[\\{}$&#_%^~]", "", found.replace(r"\textbackslash{}", ""))
    assert not re.search(r"[&#_%~]", re.sub(r"\\[a-zA-Z]+|\\['`^~=.\"]\{[a-zA-Z]\}", "", bare))
    assert bare.count("{") == bare.count("}")
    known = {*re.findall(r"\\[a-zA-Z]+", " ".join(SPECIAL.values())), r"\texttt", *(rf"\{mark}" for mark in ACCENTS.values())}
    assert set(re.findall(r"\\[a-zA-Z]+", bare)) <= known
    depth = 0
    for character in bare:
        depth += (character == "{") - (character == "}")
        assert depth >= 0


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("50 % & more", r"50 \% \& more"),
        ("a_b {c}", r"a\_b \{c\}"),
        ("--strict", "-{}-strict"),
        ("Räikkönen", r"R\"{a}ikk\"{o}nen"),
        ("ρ ≤ 0.1²", r"$\rho$ $\leq$ 0.1$^2$"),
        ("ł", r"\texttt{U+0142}"),
        ("two\nlines", "two lines"),
        ("[x] *y*", "{[}x{]} {*}y{*}"),
    ],
)
def test_examples(text: str, wanted: str) -> None:
    assert escaped(text) == wanted


def nasty() -> Table:
    rows = [
        Row((task, f"[{method} {NASTY}"), (Value(number, 0.5, 3, -1.0), Value(None)))
        for task in "ab"
        for method, number in (("x", 1), ("y", -2))
    ]
    columns = (Column("r", f"R {NASTY}", "up"), Column("s", "S", "down"), Column("o", "Gone", optional=True))
    rows = [Row(row.labels, (*row.values, Value(1))) for row in rows]
    return Table("a_{b}", NASTY, ("Task", NASTY), columns, tuple(rows), (NASTY,), (NASTY,))


def test_structure() -> None:
    lines = latex(nasty()).splitlines()
    body = [line for line in lines if not line.startswith("%")]
    assert [line for line in body if line.startswith("\\") and not line.startswith(r"\caption")] == [
        r"\begin{table}", r"\centering\small", r"\label{tab:a--b-}", r"\begin{tabular}{llrr}", r"\toprule", r"\midrule", r"\midrule",
        r"\bottomrule", r"\end{tabular}", r"\end{table}",
    ]  # fmt: skip
    rows = [line for line in body if line.endswith(r"\\")]
    assert [line.split(" & ")[0] for line in rows] == ["Task", "a", "", "b", ""]  # a task is named once
    assert all(len(re.findall(r"(?<!\\)&", line)) == 3 for line in rows)
    assert r"\textbf{1.00 $\pm$ 0.50 ($-$1.00)}" in rows[1]
    assert "n/a" in rows[1]
    assert lines[-9].startswith(r"\midrule")
    assert any(line.startswith("% 50% of") for line in lines)
    assert "% Left out: Gone." in lines


def test_a_caption_says_what_is_missing_and_not_that_nothing_is() -> None:
    whole, part = "29 of 29 planned cells are finished; none failed.", "INCOMPLETE: 2 of 29 cells are missing."
    for note, told in ((whole, False), (part, True)):
        lines = latex(replace(nasty(), notes=(note,))).splitlines()
        (caption,) = [line for line in lines if line.startswith(r"\caption")]
        assert (note in caption) == told
        assert f"% {note}" in lines
