import io
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from tests.report.markup import Outline
from wasp_cli.report.render import (
    ACCENTS,
    SPECIAL,
    escaped,
    html,
    latex,
    markdown_text,
    rendered,
    terminal,
)
from wasp_cli.report.summary import Interval, Value
from wasp_cli.report.tables import Column, Row, Table

RETURN = Column("return", "Return", "up")
COST = Column("cost", "Cost", "down", digits=1)

NARROW = Interval(-0.1, 0.6, "training", 3)


def table(
    *rows: Row, columns: tuple[Column, ...] = (RETURN, COST), notes: tuple[str, ...] = ()
) -> Table:
    return Table("t", "A title", ("Task", "Method"), columns, rows, notes)


def row(task: str, method: str, *numbers: float | Value | None) -> Row:
    return Row(
        (task, method),
        tuple(number if isinstance(number, Value) else Value(number) for number in numbers),
    )


def test_best_is_per_group_and_direction() -> None:
    found = table(
        row("a", "x", 1, 5), row("a", "y", 2, 4), row("b", "x", 9, 9), row("b", "y", 8, 10)
    )
    assert found.marks == {(1, 0), (1, 1), (2, 0), (2, 1)}


def test_equal_as_printed_share_the_mark() -> None:
    found = table(row("a", "x", 1.001, 5), row("a", "y", 1.004, 5), row("a", "z", 0.5, 5))
    assert found.marks == {(0, 0), (1, 0)}  # and nobody is best where all print the same


def test_unranked_and_undefined_are_never_best() -> None:
    found = table(
        row("a", "x", Value(99, ranked=False), Value(None)),
        row("a", "y", 2, float("nan")),
        row("a", "z", 1, 3),
    )
    assert found.marks == {(1, 0)}


def test_second_best_needs_somebody_behind() -> None:
    three = table(
        row("a", "x", 1, 5),
        row("a", "y", 2, 5),
        row("a", "z", 3, 6),
        row("a", "u", 2.001, Value(4, ranked=False)),
    )
    assert three.marks == {(2, 0), (0, 1), (1, 1)}
    # as printed they share the place; the last of two costs is no second
    assert three.seconds == {(1, 0), (3, 0)}
    assert replace(three, ranked=False).seconds == frozenset()


def test_numbers() -> None:
    percent = Column("s", "S", scale=100.0, digits=1)
    assert percent.cell(Value(0.5, 0.25, 3, delta=-0.1)) == "50.0 ± 25.0 (-10.0)"
    assert percent.cell(Value(0.5, 0.25), spread=False) == "50.0"
    assert Column("s", "S", spread=False).cell(Value(1.0, 0.5, interval=NARROW)) == "1.00"
    assert percent.cell(Value(0.5, 0.25, interval=NARROW)) == "50.0 ± 25.0 [-10.0, 60.0]"
    assert Column("s", "S", signed=True).cell(Value(0.5, interval=NARROW)) == "+0.50 [-0.10, +0.60]"
    assert COST.cell(Value(-0.01)) == "0.0"  # no negative zero
    assert COST.cell(Value(None)) == COST.cell(Value(float("nan"))) == "n/a"
    assert COST.cell(Value(1.0, delta=0.0)) == "1.0 (+0.0)"


def test_terminal_styles() -> None:
    console = Console(
        width=80,
        file=io.StringIO(),
        force_terminal=True,
        color_system="standard",
        _environ={"TERM": "xterm"},
    )
    console.print(
        terminal(table(row("a", "x", 1, 5), row("a", "y", 2, 5), row("a", "z", 3, 5)), 80)
    )
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert "\x1b[1;32m3.00" in shown
    assert "\x1b[4m2.00" in shown
    assert "m1.00" not in shown.replace("\x1b[0m", "")


@pytest.mark.parametrize(
    ("width", "spread", "delta", "optional"),
    [
        (120, True, True, True),
        (60, False, True, True),
        (44, False, True, False),
        (30, False, False, False),
    ],
)
def test_terminal_leaves_out_what_does_not_fit(
    width: int, spread: bool, delta: bool, optional: bool
) -> None:
    console = Console(width=width, file=io.StringIO(), record=True)
    wide = Value(12.25, 3.5, 3, delta=1.5)
    columns = (RETURN, COST, Column("extra", "Extra", optional=True))
    console.print(
        terminal(
            table(
                row("a", "x", wide, wide, wide),
                row("[red]b", "y", wide, wide, wide),
                columns=columns,
            ),
            width,
        )
    )
    text = console.export_text()
    assert ("±" in text, "+1.5" in text, "Extra" in text) == (spread, delta, optional)
    assert text.count("12.25") == (4 if optional else 2)
    assert ("hidden;" in text) == (width < 100)
    assert "[red]b" in text  # a label is no markup


def test_a_narrow_terminal_wraps_labels_and_cuts_no_digit() -> None:
    console = Console(width=50, file=io.StringIO(), record=True)
    label = "a measure whose name alone would fill the whole line"
    console.print(terminal(table(row("a", label, -1234.5, 0.25)), 50))
    text = console.export_text()
    assert "-1234.50" in text
    assert "0.2" in text
    assert "…" not in text
    assert "hidden" not in text  # nothing is


# Tables and pages as HTML, and text that somebody else wrote in Markdown: nothing of it becomes
# markup.


ANY = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=20)


@given(title=ANY, label=ANY, heading=ANY, note=ANY)
def test_all_text_is_escaped(title: str, label: str, heading: str, note: str) -> None:
    reader = Outline(
        html(
            Table(
                title,
                title,
                (heading,),
                (Column("k", heading),),
                (Row((label,), (Value(1.0),)),),
                (note,),
                (note,),
            )
        )
    )
    assert [name for name, _ in reader.found] == [
        "figure",
        "table",
        "caption",
        "thead",
        "tr",
        "th",
        "th",
        "tbody",
        "tr",
        "th",
        "td",
        "ul",
        "li",
        "ul",
        "li",
    ]
    assert reader.all("figure") == [{"class": "table", "id": title}]
    assert (reader.texts[2], reader.texts[5], reader.texts[9], reader.texts[12]) == (
        title,
        heading,
        label,
        note,
    )


LANE = {"height": 8, "levels": [], "curves": [], "marks": []}


@given(ANY)
def test_a_template_escapes_text_and_attributes_and_markup_only_once(name: str) -> None:
    page = rendered("timeline.html", lanes=[{**LANE, "name": name}], decisions=3)
    reader = Outline(page)
    assert [tag for tag, _ in reader.found] == ["div", "div", "span", "svg", "line"]
    assert reader.all("svg")[0]["aria-label"] == f"{name} over 3 decisions"
    assert page.count("&amp;amp;") == 2 * name.count("&amp;")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the robot starts within a hazard", "the robot starts within a hazard"),
        ("<script>x()</script>", "&lt;script>x()&lt;/script>"),
        ("a &lt; b", "a &amp;lt; b"),
        ("![p](http://there/p.png)", r"!\[p\](http://there/p.png)"),
        (r"\[a](b)", r"\\\[a\](b)"),
        ("Preset `cpu`", "Preset `cpu`"),
    ],
)
def test_it_stays_text(text: str, expected: str) -> None:
    assert markdown_text(text) == expected


LITERAL = {
    text: character
    for character, text in SPECIAL.items()
    if ord(character) < 128 and character != '"'
}
TOKENS = re.compile(
    "|".join(map(re.escape, sorted(LITERAL, key=len, reverse=True))) + r"|(?P<joined>[-,'`]\{\})|.",
    re.DOTALL,
)


def read(text: str) -> str:
    """What LaTeX prints of escaped ASCII text without quotation marks."""
    return "".join(
        each[0][0] if each["joined"] else LITERAL.get(each[0], each[0])
        for each in TOKENS.finditer(text)
    )


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
    known = {
        *re.findall(r"\\[a-zA-Z]+", " ".join(SPECIAL.values())),
        r"\texttt",
        *(rf"\{mark}" for mark in ACCENTS.values()),
    }
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


def test_a_caption_says_what_is_missing_and_not_that_nothing_is() -> None:
    whole, part = (
        "29 of 29 planned cells are finished; none failed.",
        "INCOMPLETE: 2 of 29 cells are missing.",
    )
    for note, told in (
        (whole, False),
        (part, True),
        (whole.replace("cells", "cells of what is installed here"), True),
    ):
        lines = latex(table(row("a", "x", 1, 5), notes=(note,))).splitlines()
        (caption,) = [line for line in lines if line.startswith(r"\caption")]
        assert (note in caption) == told
        assert f"% {note}" in lines
